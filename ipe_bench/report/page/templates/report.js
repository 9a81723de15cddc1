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

unfold();
