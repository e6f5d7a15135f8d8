// A small WebGL 2 renderer: points, thick lines and car meshes in, one picture from an orbiting camera out.
// Coordinates: metres, z up. Nothing is drawn unless asked for.
"use strict";

const FIELD_RAD = 0.9; // of view, from top to bottom
const NEAR_M = 0.3;
const FAR_M = 600;

const POINT_VERTEX = `#version 300 es
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
layout(location = 2) in vec4 colour; // alpha: 0 hidden, 0.5 plain, 1 larger
uniform mat4 camera;
uniform float moment, seen, pixels;
out vec3 tint;
void main() {
  uint mixed = uint(gl_VertexID) * 2654435761u;
  mixed ^= mixed >> 15;
  mixed *= 2246822519u;
  float luck = float(mixed >> 8) / 16777216.0; // points dissolve one by one
  vec4 place = camera * vec4(mix(from, to, moment), 1.0);
  tint = colour.rgb;
  bool gone = colour.a < 0.1 || luck >= seen;
  gl_Position = gone ? vec4(2.0, 2.0, 2.0, 1.0) : place;
  float larger = colour.a > 0.75 ? 1.45 : 1.0;
  gl_PointSize = larger * clamp(pixels * 0.04 / max(place.w, 0.1), pixels * 0.0022, pixels * 0.006);
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint;
out vec4 result;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  result = vec4(tint, 1.0);
}`;

// A line is four corners on the screen; ends behind the eye are drawn up to the near plane.
const LINE_VERTEX = `#version 300 es
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
layout(location = 2) in vec4 colour;
layout(location = 3) in float width;
uniform mat4 camera;
uniform vec2 canvas;
uniform float near, faded;
out vec4 tint;
void main() {
  vec4 a = camera * vec4(from, 1.0), b = camera * vec4(to, 1.0);
  if (a.w < near && b.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 way = (b.xy / b.w - a.xy / a.w) * canvas;
  vec2 across = length(way) < 1e-4 ? vec2(0.0, 1.0) : normalize(vec2(-way.y, way.x));
  float side = (gl_VertexID & 1) == 0 ? -1.0 : 1.0;
  vec4 end = gl_VertexID < 2 ? a : b;
  gl_Position = vec4(end.xy + across * side * width / canvas * end.w, end.zw);
  tint = vec4(colour.rgb, colour.a * faded);
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 tint;
out vec4 result;
void main() { result = tint; }`;

// The mesh is pushed back by a few centimetres in depth, so that points that lie on it are seen.
const MESH_VERTEX = `#version 300 es
layout(location = 0) in vec3 corner;
layout(location = 1) in vec4 colour;
uniform mat4 camera, pose;
uniform vec3 eye;
out vec3 world;
out vec4 tint;
void main() {
  vec4 place = pose * vec4(corner, 1.0);
  vec4 here = camera * place;
  vec4 behind = camera * vec4(place.xyz + 0.06 * normalize(place.xyz - eye), 1.0);
  gl_Position = vec4(here.xyz, here.w);
  gl_Position.z = behind.z / behind.w * here.w;
  world = place.xyz;
  tint = colour;
}`;

const MESH_FRAGMENT = `#version 300 es
precision highp float;
in vec3 world;
in vec4 tint;
uniform vec3 eye;
out vec4 result;
void main() {
  vec3 normal = normalize(cross(dFdx(world), dFdy(world)));
  float facing = abs(dot(normal, normalize(eye - world)));
  float light = 0.5 + 0.3 * facing + 0.25 * abs(normal.z);
  result = vec4(tint.rgb * light, tint.a);
}`;

/** The renderer on a canvas; null where the browser has no WebGL 2. */
function makeScene(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: !drawnByProcessor() });
  if (!gl) return null;
  const points = program(gl, POINT_VERTEX, POINT_FRAGMENT);
  const lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
  const meshes = program(gl, MESH_VERTEX, MESH_FRAGMENT);
  const clouds = new Map();
  const cars = new Map();
  const strokes = { buffer: gl.createBuffer(), array: gl.createVertexArray(), count: 0 };
  const camera = { target: [10, 0, -1], bearing: Math.PI, rise: 0.5, distance: 40 };

  gl.bindVertexArray(strokes.array);
  gl.bindBuffer(gl.ARRAY_BUFFER, strokes.buffer);
  [3, 3, 4, 1].reduce((from, size, location) => {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, 44, from);
    gl.vertexAttribDivisor(location, 1);
    return from + 4 * size;
  }, 0);

  function upload(buffer, values) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  }

  /** Places of a cloud (3 numbers a point) at both ends of the slider. */
  function setPlaces(name, from, to) {
    const cloud = cloudOf(name);
    cloud.count = from.length / 3;
    upload(cloud.from, from);
    upload(cloud.to, to);
  }

  /** Colours of a cloud: 4 bytes a point. */
  function setColours(name, colours) {
    upload(cloudOf(name).colours, colours);
  }

  function cloudOf(name) {
    if (clouds.has(name)) return clouds.get(name);
    const cloud = { array: gl.createVertexArray(), count: 0 };
    gl.bindVertexArray(cloud.array);
    ["from", "to", "colours"].forEach((part, location) => {
      cloud[part] = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, cloud[part]);
      gl.enableVertexAttribArray(location);
      if (part === "colours") gl.vertexAttribPointer(location, 4, gl.UNSIGNED_BYTE, true, 0, 0);
      else gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 0, 0);
    });
    clouds.set(name, cloud);
    return cloud;
  }

  /** Lines as a flat list: from (3), to (3), colour (4, 0 to 1), width in pixels. */
  function setLines(values) {
    strokes.count = values.length / 11;
    upload(strokes.buffer, new Float32Array(values));
  }

  /** A mesh: corners of triangles (9 numbers each), RGBA bytes a corner; panes are triangles from `solid` on. */
  function setMesh(name, corners, colours, solid) {
    if (!cars.has(name)) {
      const car = { array: gl.createVertexArray(), corners: gl.createBuffer(), colours: gl.createBuffer() };
      gl.bindVertexArray(car.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, car.corners);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, car.colours);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 0, 0);
      cars.set(name, car);
    }
    const car = cars.get(name);
    upload(car.corners, corners);
    upload(car.colours, colours);
    car.count = corners.length / 3;
    car.solid = 3 * solid;
  }

  function fit() {
    const finer = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * finer));
    const height = Math.max(1, Math.round(canvas.clientHeight * finer));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    return finer;
  }

  function eye() {
    const { target, bearing, rise, distance } = camera;
    return [
      target[0] + distance * Math.cos(bearing) * Math.cos(rise),
      target[1] + distance * Math.sin(bearing) * Math.cos(rise),
      target[2] + distance * Math.sin(rise),
    ];
  }

  /** Camera matrix, by columns: world to clip. */
  function matrix() {
    const { bearing, rise } = camera;
    const [cb, sb, cr, sr] = [Math.cos(bearing), Math.sin(bearing), Math.cos(rise), Math.sin(rise)];
    const right = [-sb, cb, 0];
    const up = [-cb * sr, -sb * sr, cr];
    const back = [cb * cr, sb * cr, sr];
    const from = eye();
    const along = (axis) => -(axis[0] * from[0] + axis[1] * from[1] + axis[2] * from[2]);
    const aspect = canvas.width / canvas.height;
    const fy = (1 / Math.tan(FIELD_RAD / 2)) * Math.min(1, Math.max(aspect, 0.55)); // a narrow window sees as much
    const fx = fy / aspect;
    const a = (FAR_M + NEAR_M) / (NEAR_M - FAR_M);
    const b = (2 * FAR_M * NEAR_M) / (NEAR_M - FAR_M);
    const rows = [
      [fx * right[0], fx * right[1], fx * right[2], fx * along(right)],
      [fy * up[0], fy * up[1], fy * up[2], fy * along(up)],
      [a * back[0], a * back[1], a * back[2], a * along(back) + b],
      [-back[0], -back[1], -back[2], -along(back)],
    ];
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  /**
   * Draw.
   * @param {{background: number[], clouds: {name, moment, seen}[], cars: {name, pose}[]}} what
   */
  function draw(what) {
    const finer = fit();
    const M = matrix();
    const from = eye();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...what.background, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);

    gl.useProgram(meshes.program);
    gl.uniformMatrix4fv(meshes.at("camera"), false, M);
    gl.uniform3fv(meshes.at("eye"), from);
    for (const { name, pose } of what.cars) {
      gl.uniformMatrix4fv(meshes.at("pose"), false, pose);
      gl.bindVertexArray(cars.get(name).array);
      gl.drawArrays(gl.TRIANGLES, 0, cars.get(name).solid);
    }

    gl.useProgram(points.program);
    gl.uniformMatrix4fv(points.at("camera"), false, M);
    gl.uniform1f(points.at("pixels"), Math.max(canvas.height, 500 * finer));
    for (const { name, moment, seen } of what.clouds) {
      const cloud = clouds.get(name);
      if (!cloud || !cloud.count || seen <= 0) continue;
      gl.uniform1f(points.at("moment"), moment);
      gl.uniform1f(points.at("seen"), seen >= 1 ? 2 : seen);
      gl.bindVertexArray(cloud.array);
      gl.drawArrays(gl.POINTS, 0, cloud.count);
    }

    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(lines.program);
    gl.uniformMatrix4fv(lines.at("camera"), false, M);
    gl.uniform2f(lines.at("canvas"), canvas.width / finer, canvas.height / finer);
    gl.uniform1f(lines.at("near"), NEAR_M);
    gl.bindVertexArray(strokes.array);
    gl.depthMask(false);
    for (const [compare, faded] of [[gl.GREATER, 0.35], [gl.LEQUAL, 1]]) { // what is behind something shows faintly
      gl.depthFunc(compare);
      gl.uniform1f(lines.at("faded"), faded);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, strokes.count);
    }

    gl.useProgram(meshes.program);
    for (const { name, pose } of what.cars) {
      const car = cars.get(name);
      gl.uniformMatrix4fv(meshes.at("pose"), false, pose);
      gl.bindVertexArray(car.array);
      gl.drawArrays(gl.TRIANGLES, car.solid, car.count - car.solid);
    }
    gl.depthMask(true);
  }

  /** Where a place is on the canvas, in its own pixels, and how deep (metres); null behind the eye. */
  function project(place, M = matrix()) {
    const at = (row) => M[row] * place[0] + M[4 + row] * place[1] + M[8 + row] * place[2] + M[12 + row];
    const deep = at(3);
    if (deep < NEAR_M) return null;
    const { clientWidth, clientHeight } = canvas;
    return [(at(0) / deep + 1) * 0.5 * clientWidth, (1 - at(1) / deep) * 0.5 * clientHeight, deep];
  }

  /** Until all is drawn: a pixel can be read back only then. */
  function wait() {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  return { camera, wait, setPlaces, setColours, setLines, setMesh, draw, project, matrix, eye, fit };
}

/** Whether there is no graphics card behind WebGL: smooth edges would take half of the time. */
function drawnByProcessor() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const renderer = gl ? gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "";
  if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|basic render/i.test(renderer);
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = new Map();
  return {
    program: made,
    at(name) {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
      return places.get(name);
    },
  };
}
