"use strict";

// A link to a folded part unfolds it.
function unfold() {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const part = target && target.closest("details");
  if (part) { part.open = true; target.scrollIntoView(); }
}
addEventListener("hashchange", unfold);

// Tables: sorted by a click on a heading, filtered by words.
document.querySelectorAll("table.sortable").forEach(function (table) {
  const body = table.tBodies[0];
  table.querySelectorAll("thead th").forEach(function (th, column) {
    // No real button: Chromium leaves those out of the heads that it repeats on printed pages.
    const button = document.createElement("span");
    button.setAttribute("role", "button");
    button.tabIndex = 0;
    while (th.firstChild) button.appendChild(th.firstChild);
    th.appendChild(button);
    button.addEventListener("keydown", function (event) {
      if (event.key === "Enter" || event.key === " ") { event.preventDefault(); button.click(); }
    });
    button.addEventListener("click", function () {
      const down = th.getAttribute("aria-sort") === "ascending";
      table.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
      th.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = Array.from(body.rows).sort(function (a, b) {
        const x = a.cells[column], y = b.cells[column];
        const order = x.dataset.key === undefined || y.dataset.key === undefined
          ? x.textContent.localeCompare(y.textContent, "en", { numeric: true })
          : Math.sign(Number(x.dataset.key) - Number(y.dataset.key)) || 0;
        return down ? -order : order;
      });
      body.append(...rows);
    });
  });
});

document.querySelectorAll(".tools input").forEach(function (input) {
  const rows = Array.from(document.getElementById(input.dataset.table).tBodies[0].rows);
  const count = input.parentElement.querySelector("output");
  input.addEventListener("input", function () {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    rows.forEach(function (row) {
      const cells = Array.from(row.cells, (cell) => cell.textContent.toLowerCase());
      // A number is looked for as a whole cell, a word anywhere: "1" does not find 100.
      row.hidden = !words.every((word) => cells.some((cell) =>
        isNaN(Number(word)) ? cell.includes(word) : cell === word));
      shown += row.hidden ? 0 : 1;
    });
    count.textContent = words.length ? shown + " of " + rows.length + " rows" : rows.length + " rows";
  });
});

// Matrices: what a cell knows stands at it under the pointer, on a tap and under the keyboard.
const told = document.createElement("div"), kept = new Set();
told.className = "told";
told.setAttribute("role", "status");
told.hidden = true;
document.body.append(told);
document.querySelectorAll(".matrix").forEach(function (matrix) {
  matrix.querySelectorAll("td[title]").forEach(function (cell) {
    cell.dataset.says = cell.title;
    cell.removeAttribute("title");
    cell.tabIndex = -1;
  });
  // One stop of the tabulator a table; arrows go on from there.
  const first = matrix.querySelector("[data-says]");
  if (first) first.tabIndex = 0;
  function show(event) {
    const cell = event.target.closest("[data-says]");
    told.hidden = !cell;
    if (!cell) return;
    told.textContent = cell.dataset.says;
    const at = cell.getBoundingClientRect(), below = at.bottom + told.offsetHeight + 8 < innerHeight;
    told.style.left = Math.max(4, Math.min(at.left, innerWidth - told.offsetWidth - 8)) + "px";
    told.style.top = (below ? at.bottom + 4 : at.top - told.offsetHeight - 4) + "px";
  }
  ["pointerover", "focusin", "click"].forEach((kind) => matrix.addEventListener(kind, show));
  ["pointerleave", "focusout"].forEach((kind) => matrix.addEventListener(kind, () => { told.hidden = true; }));
  matrix.addEventListener("keydown", function (event) {
    const cell = event.target.closest("[data-says]"), row = cell && cell.parentElement;
    const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
    const to = cell && step && matrix.rows[row.rowIndex + step[0]]?.cells[cell.cellIndex + step[1]];
    if (to && to.dataset.says) { event.preventDefault(); to.focus(); }
  });
});
addEventListener("scroll", () => { told.hidden = true; }, { passive: true });

// Names stand at the curves of the first panel; on a phone, where panels are below each other, those in colour stand
// above the others too.
document.querySelectorAll(".panels").forEach(function (panels) {
  const names = panels.querySelectorAll("svg:first-child [data-name] text");
  if (names.length) Array.from(panels.children).slice(1).forEach(function (panel) {
    const line = panels.insertBefore(document.createElement("div"), panel);
    line.className = "names";
    names.forEach(function (name) {
      const color = getComputedStyle(name).fill;
      if (new Set(color.match(/\d+/g)).size === 1) return;  // grey
      const word = line.appendChild(document.createElement("span"));
      word.textContent = name.textContent.replace(/,$/, "");
      word.dataset.name = name.closest("[data-name]").dataset.name;
      word.style.color = color;
    });
  });
});

// A click on names keeps these and fades the others, in matrices and figures.
function fade() {
  document.querySelectorAll("[data-name]").forEach(function (one) {
    one.classList.toggle("faded", kept.size > 0 && !kept.has(one.dataset.name));
    const name = one.querySelector(":scope > th");
    if (name) name.setAttribute("aria-pressed", String(kept.has(one.dataset.name)));
  });
}
document.querySelectorAll("[data-name]").forEach(function (one) {
  const name = one.querySelector(":scope > th") || one;
  name.style.cursor = "pointer";
  name.addEventListener("click", function () {
    if (!kept.delete(one.dataset.name)) kept.add(one.dataset.name);
    fade();
  });
  if (name === one) return;
  name.tabIndex = 0;
  name.setAttribute("role", "button");
  name.addEventListener("keydown", function (event) {
    if (event.key === "Enter" || event.key === " ") { event.preventDefault(); name.click(); }
  });
});
addEventListener("keydown", function (event) {
  if (event.key === "Escape") { told.hidden = true; kept.clear(); fade(); }
});

unfold();
