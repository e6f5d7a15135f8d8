// A pair's page: the packed pair in, what is drawn, said and answered to keys, mouse and fingers out.
//
// Scan 0 is shown in velo0. With the street held still, all of scan 1 is carried back to velo0 by the inverse of the
// ego-motion; with the scanner held still, each scan is in its own frame, and scan 0's points go along their whole flow.
"use strict";

const NAMES = ["scan0", "scan1"];
const RAMP = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"];
const GROUND_Z_M = -1.73;
const RINGS_M = [10, 20, 30, 40, 60, 80];
const EGO_M = { rear: -2.7, front: 1.6, half: 0.9, low: -1.6, high: -0.25 }; // KITTI's car round its scanner
const PICK_PX = 14;
const MOST_ARROWS = 28; // of one object
const ARROW_CELL_M = 4;
const STILL_M = 0.05;
const PLAY_S = 2.4;
const ACROSS_M = 1e-3; // what a number of a column is

const $ = (id) => document.getElementById(id);
const table = JSON.parse($("table").textContent);

let columns;
let scene;
let theme;
const state = { moment: 0, playing: 0, held: null, under: null };
const shown = { scan0: {}, scan1: {} }; // places of each scan's points as drawn: from, to, hidden

const ego = table.ego_motion;
const back = inverse(ego);
const virtual = table.objects.map((item, row) => ({ ...item, row })).filter((item) => item.origin === "virtual");
virtual.forEach((item, number) => Object.assign(item, { number }));
const carOf = new Map(virtual.map((item) => [item.row, item]));

start().catch((error) => {
  $("message").textContent = `This page cannot be shown: ${error.message}`;
  throw error;
});

async function start() {
  if (typeof DecompressionStream === "undefined") throw new Error("the browser is too old (no DecompressionStream)");
  columns = await decodeColumns($("packed").textContent, table.columns);
  $("packed").remove();
  scene = makeScene($("view"));
  if (!scene) throw new Error("the browser has no WebGL 2, or it is switched off");
  Object.assign(scene.camera, table.camera, { target: [...table.camera.target] });
  readTheme();
  describe();
  wire();
  place();
  colour();
  $("message").textContent = "";
  frame();
  scene.wait();
  document.body.dataset.readyMs = String(Math.round(performance.now()));
}

// --- small mathematics: matrices are 4 x 4, row-major -----------------------------------------------------------------

function inverse(T) {
  const R = [T[0], T[4], T[8], T[1], T[5], T[9], T[2], T[6], T[10]];
  const t = [0, 1, 2].map((i) => -(R[3 * i] * T[3] + R[3 * i + 1] * T[7] + R[3 * i + 2] * T[11]));
  return [R[0], R[1], R[2], t[0], R[3], R[4], R[5], t[1], R[6], R[7], R[8], t[2], 0, 0, 0, 1];
}

function product(A, B) {
  const out = new Array(16).fill(0);
  for (let i = 0; i < 4; i++) {
    for (let j = 0; j < 4; j++) for (let k = 0; k < 4; k++) out[4 * i + j] += A[4 * i + k] * B[4 * k + j];
  }
  return out;
}

function moved(T, x, y, z) {
  return [
    T[0] * x + T[1] * y + T[2] * z + T[3],
    T[4] * x + T[5] * y + T[6] * z + T[7],
    T[8] * x + T[9] * y + T[10] * z + T[11],
  ];
}

const between = (a, b, s) => a.map((value, i) => value + s * (b[i] - value));

function poseOfBox(box) {
  const [c, s] = [Math.cos(box[6]), Math.sin(box[6])];
  return [c, -s, 0, box[0], s, c, 0, box[1], 0, 0, 1, box[2], 0, 0, 0, 1];
}

// --- where things are --------------------------------------------------------------------------------------------------

/** Flow of a point of scan 0 as the shard has it, metres. */
function flowOf(i) {
  const { xyz0, instance0, status0, flow_rest0 } = columns;
  const p = [0, 1, 2].map((c) => xyz0[3 * i + c] * ACROSS_M);
  const item = table.objects[instance0[i]];
  const T = status0[i] === 0 && item && item.motion ? item.motion : ego;
  const q = moved(T, ...p);
  return [0, 1, 2].map((c) => q[c] - p[c] + flow_rest0[3 * i + c] * ACROSS_M);
}

/** Carries velo1 to what is drawn. */
const home = () => ($("hold").value === "street" ? back : [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);

/** Work out where every point is drawn, at both ends of the slider. */
function place() {
  const H = home();
  const opaque = $("windows").value === "opaque";
  for (const k of [0, 1]) {
    const xyz = columns[`xyz${k}`];
    const count = xyz.length / 3;
    const from = new Float32Array(xyz.length);
    const to = new Float32Array(xyz.length);
    const onPane = new Map();
    if (opaque) columns[`through${k}`].forEach((i, n) => onPane.set(i, n));
    const hidden = new Uint8Array(count);
    for (let i = 0; i < count; i++) {
      let p = [xyz[3 * i] * ACROSS_M, xyz[3 * i + 1] * ACROSS_M, xyz[3 * i + 2] * ACROSS_M];
      let q;
      if (opaque && onPane.has(i)) {
        const n = onPane.get(i);
        p = [0, 1, 2].map((c) => columns[`pane${k}`][3 * n + c] * ACROSS_M);
        q = k === 0 ? moved(table.objects[columns[`through_car${k}`][n]].motion || ego, ...p) : p;
      } else if (k === 0) {
        const f = flowOf(i);
        q = [p[0] + f[0], p[1] + f[1], p[2] + f[2]];
        if (opaque && columns.surface0[i] === 6) hidden[i] = 1; // its pane is not known
      } else {
        q = p;
        if (opaque && columns.surface1[i] === 6) hidden[i] = 1;
      }
      q = moved(H, ...q);
      if (k === 1) p = q;
      from.set(p, 3 * i);
      to.set(q, 3 * i);
    }
    Object.assign(shown[NAMES[k]], { from, to, hidden, onPane });
    scene.setPlaces(NAMES[k], from, to);
    const gone = columns[`removed${k}`];
    if (!gone) continue;
    const start = new Float32Array(gone.length);
    const end = new Float32Array(gone.length);
    for (let i = 0; i < gone.length; i += 3) {
      const p = [gone[i] * ACROSS_M, gone[i + 1] * ACROSS_M, gone[i + 2] * ACROSS_M];
      const q = moved(H, ...(k === 0 ? moved(ego, ...p) : p));
      start.set(k === 0 ? p : q, i);
      end.set(q, i);
    }
    scene.setPlaces(`removed${k}`, start, end);
  }
}

/** Matrices of an object at scan 0 and scan 1 as drawn, either null where not labelled. */
function posesOf(item) {
  const first = item.pose0 || (item.box0 && poseOfBox(item.box0));
  const second = item.pose1 || (item.box1 && poseOfBox(item.box1));
  return [first, second && product(home(), second)];
}

function poseNow(item, moment = state.moment) {
  const [first, second] = posesOf(item);
  return first && second ? between(first, second, moment) : first || second;
}

// --- colours -----------------------------------------------------------------------------------------------------------

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const rgb = (name) => bytesOfColour(style.getPropertyValue(name).trim());
  theme = {
    sky: rgb("--sky"), low: rgb("--low"), high: rgb("--high"), faint: rgb("--faint"), ink: rgb("--ink"),
    labelled: rgb("--labelled"), removed: rgb("--removed"), accent: rgb("--accent"), focus: rgb("--focus"),
    surface: [null, ...[1, 2, 3, 4, 5, 6, 7].map((n) => rgb(`--surface-${n}`))],
    cars: [0, 1, 2, 3, 4, 5].map((n) => rgb(`--car-${n}`)),
    ramp: [Number(style.getPropertyValue("--ramp-from")), Number(style.getPropertyValue("--ramp-to"))],
  };
}

function bytesOfColour(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
}

const carColour = (item) => theme.cars[item.number % theme.cars.length];
const css = (rgb) => `rgb(${rgb.map(Math.round).join(",")})`;

function ramp(share) {
  const s = theme.ramp[0] + Math.min(1, Math.max(0, share)) * (theme.ramp[1] - theme.ramp[0]);
  const at = Math.min(RAMP.length - 2, Math.floor(s * (RAMP.length - 1)));
  return between(bytesOfColour(RAMP[at]), bytesOfColour(RAMP[at + 1]), s * (RAMP.length - 1) - at);
}

const byHeight = (z) => between(theme.low, theme.high, Math.min(1, Math.max(0, (z - GROUND_Z_M + 0.2) / 4)));

const GLASS_WORDS = [
  ["on a pane", 2], ["inside, seen through glass", 6], ["beyond the car, through its windows", 4],
];

/** Colour each point; alpha says plain (128), larger (255) or hidden (0). */
function colour() {
  const mode = $("colour").value;
  const fastest = 20;
  for (const k of [0, 1]) {
    const { from, to, hidden } = shown[NAMES[k]];
    const at = (name) => columns[`${name}${k}`];
    const [xyz, ring, surface, instance, reflectance] = ["xyz", "ring", "surface", "instance", "reflectance"].map(at);
    const rings = Math.max(1, table.beams.side.length - 1);
    const came = new Set(columns[`through${k}`]);
    const count = ring.length;
    const bytes = new Uint8Array(4 * count);
    const still = $("hold").value === "street";
    for (let i = 0; i < count; i++) {
      const z = xyz[3 * i + 2] * ACROSS_M;
      const item = table.objects[instance[i]];
      const car = carOf.get(instance[i]);
      let rgb;
      let larger = surface[i] > 0;
      if (mode === "surface") {
        rgb = surface[i] ? theme.surface[surface[i]] || theme.faint : byHeight(z);
      } else if (mode === "object") {
        rgb = car ? carColour(car) : item ? theme.labelled : byHeight(z);
        larger = Boolean(car);
      } else if (mode === "glass") {
        larger = surface[i] === 2 || surface[i] === 6 || came.has(i);
        rgb = surface[i] === 2 || surface[i] === 6 ? theme.surface[surface[i]] : came.has(i) ? theme.surface[4] : null;
        rgb = rgb || (car ? theme.faint : between(theme.sky, byHeight(z), 0.45));
      } else if (mode === "speed") {
        const way = k === 0 ? speedOf(i, still ? [from, to] : null) : 0;
        rgb = k === 1 || way < 0.5 ? between(theme.sky, byHeight(z), 0.55) : ramp(way / fastest);
        larger = k === 0 && way >= 0.5;
      } else if (mode === "height") {
        rgb = ramp((z - GROUND_Z_M + 0.2) / 5);
      } else if (mode === "range") {
        rgb = ramp(Math.log(Math.max(3, Math.hypot(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]) * ACROSS_M) / 3) / Math.log(80 / 3));
      } else if (mode === "reflectance") {
        rgb = ramp(Math.sqrt(reflectance[i] / 255));
      } else if (mode === "ring") {
        rgb = ramp(ring[i] / rings);
      } else if (mode === "status") {
        const unknown = k === 0 && columns.status0[i] !== 0;
        rgb = unknown ? theme.surface[4] : between(theme.sky, byHeight(z), 0.55);
        larger = unknown;
      } else {
        rgb = k === 0 ? theme.surface[1] : theme.surface[4];
        larger = false;
      }
      const gone = hidden[i] || (!$("through").checked && (surface[i] === 6 || came.has(i)));
      bytes[4 * i] = rgb[0];
      bytes[4 * i + 1] = rgb[1];
      bytes[4 * i + 2] = rgb[2];
      bytes[4 * i + 3] = gone ? 0 : larger ? 255 : 128;
      hidden[i] = (hidden[i] & 1) | (gone ? 2 : 0);
    }
    scene.setColours(NAMES[k], bytes);
    const gone = columns[`removed${k}`];
    if (gone) {
      const red = new Uint8Array((gone.length / 3) * 4);
      for (let i = 0; i < red.length; i += 4) red.set([...theme.removed, 128], i);
      scene.setColours(`removed${k}`, red);
    }
  }
  for (const item of virtual) paintMesh(item);
  legend(mode, fastest);
}

/** Speed over ground of a point of scan 0, m/s. */
function speedOf(i, places) {
  const seconds = table.interval_s > 0 ? table.interval_s : 0.1;
  if (places) {
    const [from, to] = places;
    return Math.hypot(to[3 * i] - from[3 * i], to[3 * i + 1] - from[3 * i + 1], to[3 * i + 2] - from[3 * i + 2]) / seconds;
  }
  const p = [0, 1, 2].map((c) => columns.xyz0[3 * i + c] * ACROSS_M);
  const f = flowOf(i);
  const q = moved(back, p[0] + f[0], p[1] + f[1], p[2] + f[2]);
  return Math.hypot(q[0] - p[0], q[1] - p[1], q[2] - p[2]) / seconds;
}

function legend(mode, fastest) {
  const marks = [];
  const mark = (words, rgb) => marks.push(`<span><i style="--mark:${css(rgb)}"></i>${words}</span>`);
  const scale = (from, to) => {
    const stops = [0, 0.25, 0.5, 0.75, 1].map((s) => css(ramp(s))).join(",");
    marks.push(`<span>${from}</span><span class="ramp" style="background:linear-gradient(90deg,${stops})"></span><span>${to}</span>`);
  };
  const present = new Set([...columns.surface0, ...columns.surface1]);
  if (mode === "surface") {
    mark("measured, by height", between(theme.low, theme.high, 0.5));
    for (let s = 1; s < 8; s++) if (present.has(s)) mark(table.surfaces[s], theme.surface[s]);
  } else if (mode === "object") {
    for (const item of virtual) mark(`car ${item.number + 1}`, carColour(item));
    if (table.objects.some((item) => item.origin !== "virtual")) mark("labelled object", theme.labelled);
  } else if (mode === "glass") {
    for (const [words, n] of GLASS_WORDS) mark(words, theme.surface[n]);
  } else if (mode === "status") {
    mark("flow known", theme.faint);
    mark("not known (status 1)", theme.surface[4]);
  } else if (mode === "scan") {
    mark("scan 0", theme.surface[1]);
    mark("scan 1", theme.surface[4]);
  } else if (mode === "speed") scale("0.5 m/s", `${fastest} m/s and more; standing: grey`);
  else if (mode === "height") scale("ground", "5 m");
  else if (mode === "range") scale("3 m", "80 m");
  else if (mode === "reflectance") scale("0", "1");
  else scale("highest ring", "lowest");
  if (columns.removed0 && table.removed.some(Boolean) && $("removed").checked) mark("removed", theme.removed);
  $("legend").innerHTML = marks.join("");
}

function paintMesh(item) {
  if (item.mesh === null) return;
  const faces = columns[`faces_${item.mesh}`];
  const kinds = columns[`kinds_${item.mesh}`];
  const vertices = columns[`vertices_${item.mesh}`];
  const opaque = $("windows").value === "opaque";
  const order = [...kinds.keys()].sort((a, b) => (kinds[a] === 2) - (kinds[b] === 2));
  const corners = new Float32Array(9 * order.length);
  const bytes = new Uint8Array(12 * order.length);
  const paint = $("colour").value === "object" ? between(carColour(item), [255, 255, 255], 0.35) : between([214, 219, 226], carColour(item), 0.12);
  const rgba = [null, [...paint, 255], [...between(theme.surface[2], [20, 40, 60], 0.55), opaque ? 255 : 60],
    [38, 40, 44, 255], [255, 226, 150, 255], [96, 104, 116, 255]];
  order.forEach((face, n) => {
    for (let c = 0; c < 3; c++) {
      const vertex = faces[3 * face + c];
      for (let axis = 0; axis < 3; axis++) corners[9 * n + 3 * c + axis] = vertices[3 * vertex + axis] * ACROSS_M;
      bytes.set(rgba[kinds[face]] || rgba[5], 12 * n + 4 * c);
    }
  });
  const glass = order.findIndex((face) => kinds[face] === 2);
  scene.setMesh(item.row, corners, bytes, opaque || glass < 0 ? order.length : glass);
}

// --- lines -------------------------------------------------------------------------------------------------------------

function strokes() {
  const out = [];
  const line = (a, b, rgb, alpha = 1, width = 1) =>
    out.push(a[0], a[1], a[2], b[0], b[1], b[2], rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, alpha, width);
  const dashed = (a, b, rgb, alpha) => {
    const pieces = Math.max(1, Math.round(Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) / 0.5));
    for (let n = 0; n < pieces; n++) line(between(a, b, n / pieces), between(a, b, (n + 0.55) / pieces), rgb, alpha, 1);
  };
  const T = egoNow();
  if ($("rings").checked) {
    for (const radius of RINGS_M) {
      for (let n = 0; n < 96; n++) {
        const [a, b] = [n, n + 1].map((m) => (m * 2 * Math.PI) / 96);
        line(
          moved(T, radius * Math.cos(a), radius * Math.sin(a), GROUND_Z_M),
          moved(T, radius * Math.cos(b), radius * Math.sin(b), GROUND_Z_M),
          theme.faint, 0.4,
        );
      }
    }
  }
  egoCar(T, line);
  if ($("boxes").checked) {
    for (const item of [...table.objects.filter((o) => o.origin !== "virtual"), ...virtual]) {
      const rgb = item.origin === "virtual" ? carColour(item) : theme.labelled;
      const size = (item.box0 || item.box1 || []).slice(3, 6);
      if (!size.length) continue;
      const [first, second] = posesOf(item);
      if (first && state.moment > 0.001) box(first, size, (a, b) => dashed(a, b, rgb, 0.6));
      if (second && state.moment < 0.999) box(second, size, (a, b) => dashed(a, b, rgb, 0.6));
      const alone = !first || !second; // labelled in one scan only: dashed is all that is drawn, but at its own moment
      if (!alone || (first ? state.moment <= 0.001 : state.moment >= 0.999)) {
        box(poseNow(item), size, (a, b) => line(a, b, rgb, 1, item.origin === "virtual" ? 1.6 : 1.1), true);
      }
    }
  }
  if ($("flow").checked && $("scan0").checked) for (const i of arrowRows()) arrow(i, line);
  if (state.under) ray(state.under, line);
  return out;
}

function egoNow() {
  const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  return $("hold").value === "street" ? between(identity, back, state.moment) : identity;
}

function egoCar(T, line) {
  const { rear, front, half, low, high } = EGO_M;
  const middle = moved(T, (rear + front) / 2, 0, (low + high) / 2);
  const pose = [...T];
  [pose[3], pose[7], pose[11]] = middle;
  box(pose, [front - rear, 2 * half, high - low], (a, b) => line(a, b, theme.faint, 0.9, 1.2), true);
  line(moved(T, 0, 0, high), moved(T, 0, 0, 0), theme.ink, 1, 3);
}

/** The twelve edges of a box, and a nose on its front. */
function box(pose, size, line, nose = false) {
  const corner = (n) => moved(pose, ((n & 1) - 0.5) * size[0], (((n >> 1) & 1) - 0.5) * size[1], ((n >> 2) - 0.5) * size[2]);
  for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) line(corner(a), corner(a | bit));
  if (!nose) return;
  const tip = moved(pose, 0.5 * size[0], 0, -0.5 * size[2]);
  const root = moved(pose, 0.2 * size[0], 0, -0.5 * size[2]);
  line(root, corner(1));
  line(root, corner(3));
  line(root, tip);
}

let arrowsFor = null;
/** Points of scan 0 that get an arrow: a share of each object's, and one of each cell of the rest that moves. */
function arrowRows() {
  const { from, to } = shown.scan0;
  if (arrowsFor && arrowsFor.from === from) return arrowsFor.rows;
  const far = (i) => Math.hypot(to[3 * i] - from[3 * i], to[3 * i + 1] - from[3 * i + 1]) > STILL_M;
  const rows = [];
  const cells = new Set();
  const mine = new Map();
  columns.instance0.forEach((row, i) => {
    if (!far(i)) return;
    if (row >= 0) {
      if (!mine.has(row)) mine.set(row, []);
      mine.get(row).push(i);
      return;
    }
    const cell = `${Math.floor(from[3 * i] / ARROW_CELL_M)},${Math.floor(from[3 * i + 1] / ARROW_CELL_M)}`;
    if (cells.has(cell) || columns.status0[i] !== 0) return;
    cells.add(cell);
    rows.push(i);
  });
  for (const points of mine.values()) {
    const step = Math.max(1, Math.floor(points.length / MOST_ARROWS));
    for (let n = 0; n < points.length; n += step) rows.push(points[n]);
  }
  arrowsFor = { from, rows };
  return rows;
}

function arrow(i, line) {
  const { from, to, hidden } = shown.scan0;
  if (hidden[i]) return;
  const a = [from[3 * i], from[3 * i + 1], from[3 * i + 2]];
  const b = [to[3 * i], to[3 * i + 1], to[3 * i + 2]];
  const way = b.map((value, c) => value - a[c]);
  const length = Math.hypot(...way);
  const car = carOf.get(columns.instance0[i]);
  const rgb = car ? theme.ink : columns.instance0[i] >= 0 ? theme.labelled : theme.accent;
  const alpha = columns.instance0[i] >= 0 ? 0.9 : 0.55;
  line(a, b, rgb, alpha, car ? 1.3 : 1);
  const head = Math.min(0.3 * length, 0.25) / length;
  const across = [-way[1], way[0]];
  for (const side of [-0.5, 0.5]) {
    line(b, [
      b[0] - head * way[0] + side * head * across[0],
      b[1] - head * way[1] + side * head * across[1],
      b[2] - head * way[2],
    ], rgb, alpha, car ? 1.3 : 1);
  }
}

/** Where the beam of a point starts, in its own velo frame. */
function beamOrigin(k, i) {
  const [x, y] = [columns[`xyz${k}`][3 * i] * ACROSS_M, columns[`xyz${k}`][3 * i + 1] * ACROSS_M];
  const ring = Math.min(columns[`ring${k}`][i], table.beams.side.length - 1);
  const side = table.beams.side[ring];
  const azimuth = Math.atan2(y, x) - Math.asin(Math.min(1, Math.max(-1, side / Math.max(1e-6, Math.hypot(x, y)))));
  return [-side * Math.sin(azimuth), side * Math.cos(azimuth), table.beams.height[ring]];
}

function ray({ k, i }, line) {
  const { from, to } = shown[NAMES[k]];
  const origin = k === 0 ? beamOrigin(k, i) : moved(home(), ...beamOrigin(k, i));
  const at = [from[3 * i], from[3 * i + 1], from[3 * i + 2]];
  line(origin, at, theme.focus, 1, 2);
  const now = between(at, [to[3 * i], to[3 * i + 1], to[3 * i + 2]], momentOf(k));
  const size = 0.012 * Math.hypot(...scene.eye().map((value, c) => value - now[c]));
  for (let axis = 0; axis < 3; axis++) {
    const [a, b] = [[...now], [...now]];
    a[axis] -= size;
    b[axis] += size;
    line(a, b, theme.focus, 1, 3);
  }
  const n = columns[`through${k}`].indexOf(i);
  if (n >= 0 && $("windows").value !== "opaque") { // where it went through the pane
    const pane = [0, 1, 2].map((c) => columns[`pane${k}`][3 * n + c] * ACROSS_M);
    const spot = k === 0 ? pane : moved(home(), ...pane);
    line([spot[0], spot[1], spot[2] - 1.5 * size], [spot[0], spot[1], spot[2] + 1.5 * size], theme.surface[2], 1, 4);
  }
}

// --- drawing -----------------------------------------------------------------------------------------------------------

/** How far along its way scan k is drawn, and which share of its points. */
const momentOf = (k) => (k === 0 && $("between").value === "move" ? state.moment : 0);

function seenOf(k) {
  if (!$(NAMES[k]).checked) return 0;
  if (!$(NAMES[1 - k]).checked) return 1; // alone it is never faded
  if (k === 1) return state.moment;
  return $("between").value === "move" ? 1 : 1 - state.moment;
}

let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame((now) => {
    asked = false;
    if (state.playing) step(now);
    frame();
  });
}

function frame() {
  const clouds = [];
  for (const k of [0, 1]) {
    clouds.push({ name: NAMES[k], moment: momentOf(k), seen: seenOf(k) });
    if ($("removed").checked) clouds.push({ name: `removed${k}`, moment: momentOf(k), seen: seenOf(k) });
  }
  const cars = $("windows").value === "none" ? [] : virtual
    .filter((item) => item.mesh !== null && poseNow(item))
    .map((item) => ({ name: item.row, pose: transposed(poseNow(item)) }));
  scene.setLines(strokes());
  scene.draw({ background: theme.sky.map((value) => value / 255), clouds, cars });
  label();
}

function transposed(T) {
  return new Float32Array([0, 1, 2, 3].flatMap((c) => [0, 1, 2, 3].map((r) => T[4 * r + c])));
}

const labels = new Map();
function label() {
  const M = scene.matrix();
  const put = (name, kind, place, words, rgb) => {
    const at = place && scene.project(place, M);
    let element = labels.get(name);
    if (!element) {
      element = document.createElement("span");
      element.className = kind;
      $("labels").append(element);
      labels.set(name, element);
    }
    const { clientWidth, clientHeight } = $("view");
    element.hidden = !at || at[0] < 0 || at[1] < 14 || at[0] > clientWidth || at[1] > clientHeight;
    if (element.hidden) return;
    element.textContent = words;
    element.style.left = `${at[0].toFixed(1)}px`;
    element.style.top = `${at[1].toFixed(1)}px`;
    if (rgb) element.style.setProperty("--mark", css(rgb));
  };
  for (const item of virtual) {
    const pose = poseNow(item);
    const top = pose && moved(pose, 0, 0, 0.5 * (item.box0 || item.box1 || [0, 0, 0, 0, 0, 1.6])[5] + 0.25);
    put(`car${item.row}`, "car", top, `${item.number + 1}: ${figure(item.speed, 1)} m/s`, carColour(item));
  }
  const T = egoNow();
  put("ego", "ring", moved(T, 0, 0, 0.6), "ego car");
  const towards = Math.atan2(scene.camera.target[1] - T[7], scene.camera.target[0] - T[3]);
  for (const radius of RINGS_M) {
    const spot = moved(T, radius * Math.cos(towards), radius * Math.sin(towards), GROUND_Z_M);
    put(`ring${radius}`, "ring", $("rings").checked ? spot : null, `${radius} m`);
  }
}

// --- the ray under the cursor ------------------------------------------------------------------------------------------

/** The point drawn nearest to a place on the canvas: {k, i}, or null. */
function pick(x, y) {
  const M = scene.matrix();
  const { clientWidth, clientHeight } = $("view");
  let best = null;
  let least = PICK_PX;
  for (const k of [0, 1]) {
    if (seenOf(k) <= 0.02) continue;
    const { from, to, hidden } = shown[NAMES[k]];
    const s = momentOf(k);
    for (let i = 0, j = 0; i < hidden.length; i++, j += 3) {
      if (hidden[i]) continue;
      const a = from[j] + s * (to[j] - from[j]);
      const b = from[j + 1] + s * (to[j + 1] - from[j + 1]);
      const c = from[j + 2] + s * (to[j + 2] - from[j + 2]);
      const deep = M[3] * a + M[7] * b + M[11] * c + M[15];
      if (deep < NEAR_M) continue;
      const u = ((M[0] * a + M[4] * b + M[8] * c + M[12]) / deep + 1) * 0.5 * clientWidth - x;
      if (u > least || u < -least) continue;
      const v = (1 - (M[1] * a + M[5] * b + M[9] * c + M[13]) / deep) * 0.5 * clientHeight - y;
      const off = Math.hypot(u, v) + Math.min(4, 0.05 * deep); // of two near the cursor, the one in front
      if (off < least) [least, best] = [off, { k, i }];
    }
  }
  return best;
}

function point(found, held) {
  state.under = found;
  state.held = held ? found : null;
  tell(found);
  redraw();
}

function tell(found) {
  const rows = [];
  if (found) {
    const { k, i } = found;
    const at = (name) => columns[`${name}${k}`];
    const p = [0, 1, 2].map((c) => at("xyz")[3 * i + c] * ACROSS_M);
    const origin = beamOrigin(k, i);
    const item = table.objects[at("instance")[i]];
    const car = carOf.get(at("instance")[i]);
    const n = at("through").indexOf(i);
    rows.push(["scan, row", `${k}, ${i}${state.held ? " (held)" : ""}`]);
    rows.push(["ring, tick", `${at("ring")[i]}, ${at("tick")[i] === 65535 ? "not known" : at("tick")[i]}`]);
    rows.push(["range", `${figure(Math.hypot(p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]), 3)} m`]);
    rows.push(["place", `${p.map((value) => figure(value, 2)).join(", ")} m (velo${k})`]);
    rows.push(["surface", table.surfaces[at("surface")[i]] || String(at("surface")[i])]);
    rows.push(["instance", item ? `${at("instance")[i]}: ${car ? `virtual car ${car.number + 1}, ` : "labelled "}${item.category} ${item.model || item.id}` : "none"]);
    if (n >= 0) {
      const through = carOf.get(at("through_car")[n]);
      rows.push(["window", `came through a pane of virtual car ${through ? through.number + 1 : "?"}`]);
    }
    if (k === 0) {
      const f = flowOf(i);
      rows.push(["flow", `${f.map((value) => figure(value, 3)).join(", ")} m (${figure(Math.hypot(...f), 3)})`]);
      rows.push(["flow status", columns.status0[i] === 0 ? "0, known" : `${columns.status0[i]}, not known`]);
      rows.push(["speed", `${figure(speedOf(i, null), 2)} m/s over ground`]);
    } else rows.push(["flow", "of scan 0 only"]);
    rows.push(["reflectance", figure(at("reflectance")[i] / 255, 2)]);
    rows.push(["source row", at("source")[i] < 0 ? "none: simulated" : String(at("source")[i])]);
  }
  fill($("ray"), rows);
  $("ray-hint").hidden = Boolean(found);
  // a screen reader hears held rays only, not all that the mouse passes over
  const said = rows.slice(1, 6).map(([name, value]) => `${name} ${value}`).join("; ");
  if (state.held || !found) $("spoken").textContent = said;
}

function fill(list, rows) {
  list.replaceChildren(...rows.flatMap(([name, value]) => {
    const [term, words] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    words.textContent = value;
    return [term, words];
  }));
}

const figure = (value, digits) => (value === null || value === undefined ? "?" : value.toFixed(digits).replace("-", "\u2212"));

/** The next point on the held point's ring, to the left (1) or to the right (-1). */
function along(way) {
  const here = state.under || pick($("view").clientWidth / 2, $("view").clientHeight / 2);
  if (!here) return;
  const { k, i } = here;
  const [xyz, ring] = [columns[`xyz${k}`], columns[`ring${k}`]];
  const { hidden } = shown[NAMES[k]];
  const bearing = (n) => Math.atan2(xyz[3 * n + 1], xyz[3 * n]);
  const rows = [...ring.keys()].filter((n) => ring[n] === ring[i] && !hidden[n]).sort((a, b) => bearing(a) - bearing(b));
  point({ k, i: rows[(rows.indexOf(i) + way + rows.length) % rows.length] }, true);
}

// --- what is said beside the picture -----------------------------------------------------------------------------------

function describe() {
  for (const item of virtual) {
    const entry = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    const range = item.box0 ? Math.hypot(item.box0[0], item.box0[1]) : null;
    const name = document.createElement("b");
    name.textContent = `${item.number + 1}: ${item.model || item.category}`;
    const more = document.createElement("small");
    more.textContent = `${figure(item.speed, 1)} m/s, ${figure(range, 1)} m away, ` +
      `${item.points0} and ${item.points1} points of ${item.rays0 ?? "?"} and ${item.rays1 ?? "?"} rays`;
    button.append(name, more);
    button.style.setProperty("--mark", css(carColour(item)));
    button.addEventListener("click", () => goTo(item));
    entry.append(button);
    $("cars").append(entry);
  }
  if (!virtual.length) $("cars").textContent = "none in this pair";
  const without = virtual.filter((item) => item.mesh === null).map((item) => item.model || item.category);
  const words = [];
  if (without.length) {
    words.push(`No mesh at hand of ${[...new Set(without)].join(", ")} (give --cad): box and points only, and what was ` +
      "seen beyond its windows cannot be told.");
  }
  if (without.length < virtual.length) {
    words.push("Opaque: what came through a pane is put where the pane would have returned it.");
  } else if (virtual.length) words.push("Opaque: what was seen through glass is left out.");
  $("windows-note").textContent = words.join(" ");
  const [gone0, gone1] = table.removed;
  if (!columns.removed0) {
    $("removed").checked = false;
    $("removed").disabled = true;
    $("removed-note").textContent = `Cars hide ${gone0} and ${gone1} points of the source; ${table.removed_note}.`;
  } else $("removed-note").textContent = `Cars hide ${gone0} and ${gone1} points of the source scans.`;
  const step = Math.hypot(ego[3], ego[7]);
  fill($("facts"), [
    ["sequence", table.sequence], ["recording", table.recording], ["frames", table.frames.join(" and ")],
    ["points", `${columns.ring0.length.toLocaleString("en")} and ${columns.ring1.length.toLocaleString("en")}`],
    ["scans", table.kind], ["apart", `${figure(table.interval_s * 1000, 1)} ms`],
    ["ego car", `${figure(step, 2)} m, ${figure(table.interval_s > 0 ? step / table.interval_s : null, 1)} m/s (${table.ego_source})`],
    ["labelled", `${table.objects.length - virtual.length} objects, coverage ${table.coverage}`],
  ]);
}

// --- hands -------------------------------------------------------------------------------------------------------------

function goTo(item) {
  const pose = poseNow(item);
  if (!pose) return;
  const home = Math.atan2(-pose[7], -pose[3]);
  Object.assign(scene.camera, { target: [pose[3], pose[7], pose[11]], bearing: home + 0.5, rise: 0.35, distance: 9 });
  redraw();
}

function turn(right, up) {
  scene.camera.bearing -= right;
  scene.camera.rise = Math.min(1.5, Math.max(-0.3, scene.camera.rise + up));
  redraw();
}

/** Move the target in the ground plane, by shares of the distance. */
function shift(right, ahead) {
  const { bearing, distance, target } = scene.camera;
  target[0] += distance * (-Math.sin(bearing) * right - Math.cos(bearing) * ahead);
  target[1] += distance * (Math.cos(bearing) * right - Math.sin(bearing) * ahead);
  redraw();
}

function zoom(factor) {
  scene.camera.distance = Math.min(250, Math.max(1.5, scene.camera.distance * factor));
  redraw();
}

function setMoment(moment) {
  state.moment = Math.min(1, Math.max(0, moment));
  $("time").value = state.moment;
  $("time").setAttribute("aria-valuetext", `${Math.round(100 * state.moment)} % of the way to scan 1`);
  redraw();
}

function play(on) {
  state.playing = on ? performance.now() : 0;
  state.first = state.moment >= 0.999 ? 0 : state.moment;
  $("play").textContent = on ? "\u23F8" : "\u25B6";
  $("play").setAttribute("aria-label", on ? "Pause" : "Play from scan 0 to scan 1");
  redraw();
}

function step(now) {
  const moment = state.first + Math.max(0, now - state.playing) / 1000 / PLAY_S;
  setMoment(moment);
  if (moment >= 1) play(false);
  else redraw();
}

function cycle(id) {
  const list = $(id);
  list.selectedIndex = (list.selectedIndex + 1) % list.length;
  list.dispatchEvent(new Event("change"));
}

function toggle(id) {
  if ($(id).disabled) return;
  $(id).checked = !$(id).checked;
  $(id).dispatchEvent(new Event("change"));
}

function scans() {
  const [a, b] = NAMES.map((name) => $(name).checked);
  const [c, d] = a && b ? [true, false] : a ? [false, true] : [true, true];
  [$("scan0").checked, $("scan1").checked] = [c, d];
  redraw();
}

const KEYS = {
  ArrowLeft: (fine) => (fine ? shift(-0.05, 0) : turn(-0.08, 0)),
  ArrowRight: (fine) => (fine ? shift(0.05, 0) : turn(0.08, 0)),
  ArrowUp: (fine) => (fine ? shift(0, 0.05) : turn(0, 0.06)),
  ArrowDown: (fine) => (fine ? shift(0, -0.05) : turn(0, -0.06)),
  "+": () => zoom(1 / 1.15), "=": () => zoom(1 / 1.15), "-": () => zoom(1.15), _: () => zoom(1.15),
  Home: () => { Object.assign(scene.camera, table.camera, { target: [...table.camera.target] }); redraw(); },
  t: () => { Object.assign(scene.camera, { rise: 1.5, bearing: Math.PI, distance: Math.max(scene.camera.distance, 40) }); redraw(); },
  " ": () => play(!state.playing), "[": () => setMoment(state.moment - 0.1), "]": () => setMoment(state.moment + 0.1),
  c: () => cycle("colour"), w: () => cycle("windows"), m: () => cycle("between"), h: () => cycle("hold"),
  f: () => toggle("flow"), b: () => toggle("boxes"), v: () => toggle("through"), x: () => toggle("removed"),
  g: () => toggle("rings"), 0: scans,
  r: () => point(pick($("view").clientWidth / 2, $("view").clientHeight / 2), true),
  ",": () => along(1), ".": () => along(-1), Escape: () => point(null, false),
  p: () => follow("prev"), n: () => follow("next"), i: () => { location.href = "../index.html"; },
  "?": () => $("help").showModal(),
};

function follow(rel) {
  const link = document.querySelector(`a[rel="${rel}"]`);
  if (link) location.href = link.href;
}

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open) return;
  const tag = event.target.tagName;
  const own = tag === "SELECT" || event.target.type === "range"; // they answer to arrows and letters themselves
  const presses = ["BUTTON", "INPUT", "A", "SUMMARY"].includes(tag) && event.key === " ";
  if ((own && event.key !== "?" && event.key !== "Escape") || presses) return;
  const number = Number(event.key);
  if (number >= 1 && virtual[number - 1]) goTo(virtual[number - 1]);
  else {
    const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    action(event.shiftKey);
  }
  event.preventDefault();
}

function wire() {
  document.addEventListener("keydown", pressed);
  for (const id of ["windows", "hold"]) $(id).addEventListener("change", () => { place(); colour(); redraw(); });
  for (const id of ["colour", "through", "removed"]) $(id).addEventListener("change", () => { colour(); redraw(); });
  for (const id of ["between", "scan0", "scan1", "flow", "boxes", "rings"]) $(id).addEventListener("change", redraw);
  $("time").addEventListener("input", () => { play(false); setMoment(Number($("time").value)); });
  $("play").addEventListener("click", () => play(!state.playing));
  $("help-button").addEventListener("click", () => $("help").showModal());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readTheme();
    $("cars").replaceChildren();
    describe();
    colour();
    redraw();
  });
  new ResizeObserver(redraw).observe($("view"));
  pointers($("view"));
}

function pointers(canvas) {
  const down = new Map();
  let travelled = 0;
  let pending = null;
  const place = (event) => [event.offsetX, event.offsetY];
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, place(event));
    travelled = down.size > 1 ? Infinity : 0;
    canvas.focus({ preventScroll: true, focusVisible: false });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId);
    if (!before) {
      if (state.held || event.pointerType === "touch") return;
      if (!pending) requestAnimationFrame(() => { const at = pending; pending = null; if (at && !state.held) point(pick(...at), false); });
      pending = place(event);
      return;
    }
    const now = place(event);
    const [right, low] = [now[0] - before[0], now[1] - before[1]];
    travelled += Math.hypot(right, low);
    if (down.size === 2) {
      const other = [...down].find(([id]) => id !== event.pointerId)[1];
      const apart = (at) => Math.max(10, Math.hypot(at[0] - other[0], at[1] - other[1]));
      zoom(apart(before) / apart(now));
      shift(-right / 2 / canvas.clientHeight, low / 2 / canvas.clientHeight);
    } else if (event.buttons === 2 || event.shiftKey) shift(-right / canvas.clientHeight, low / canvas.clientHeight);
    else turn(right / 200, low / 200);
    down.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      down.delete(event.pointerId);
      if (end === "pointerup" && travelled < 5 && event.button === 0) point(pick(...place(event)), true);
    });
  }
  canvas.addEventListener("pointerleave", () => { pending = null; if (!state.held && state.under) point(null, false); });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(Math.sign(event.deltaY) * 0.12)); }, { passive: false });
}
