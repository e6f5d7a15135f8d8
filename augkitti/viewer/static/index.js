// Filters and order of the index page; without it all pairs are listed.
"use strict";

(() => {
  const list = document.getElementById("cards");
  const form = document.getElementById("filters");
  const cards = [...list.children].map((element, place) => ({
    element,
    place,
    sequence: element.dataset.sequence,
    cars: JSON.parse(element.dataset.cars), // [speed, range, points] of each virtual car
  }));
  const MEASURES = ["speed", "range", "points"];

  const number = (id) => {
    const text = document.getElementById(id).value;
    return text === "" ? null : Number(text);
  };

  function apply() {
    const sequence = document.getElementById("sequence").value;
    const limits = MEASURES.map((name) => [number(`${name}-from`), number(`${name}-to`)]);
    const asked = limits.some(([from, to]) => from !== null || to !== null);
    const fits = (car) =>
      limits.every(([from, to], m) => (from === null || car[m] >= from) && (to === null || car[m] <= to));
    let shown = 0;
    for (const card of cards) {
      const stays = (!sequence || card.sequence === sequence) && (!asked || card.cars.some(fits));
      card.element.hidden = !stays;
      shown += stays;
    }
    const order = MEASURES.indexOf(document.getElementById("order").value);
    const sign = MEASURES[order] === "range" ? 1 : -1;
    const key = (card) =>
      order < 0 || !card.cars.length ? Infinity : Math.min(...card.cars.map((car) => sign * car[order]));
    const sorted = order < 0 ? cards : [...cards].sort((a, b) => key(a) - key(b) || a.place - b.place);
    list.append(...sorted.map((card) => card.element));
    document.getElementById("shown").textContent = `${shown} of ${cards.length} shown`;
    document.getElementById("nothing").hidden = shown > 0;
  }

  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(apply));
  document.getElementById("clear").addEventListener("click", () => form.reset());
  apply();
})();
