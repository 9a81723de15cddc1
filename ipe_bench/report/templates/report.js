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

// Charts: each is drawn from the numbers that stand beside it, again whenever its width or one of its controls changes.
// Nothing is fetched, and texts are set as texts.
const MARGIN = { top: 10, right: 14, bottom: 44, left: 62 };

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

function element(name, attributes, ...children) { return filled(document.createElement(name), attributes, children); }
function shape(name, attributes, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function written(value, share) {
  if (value === null) return "-";
  if (share) return Number((100 * value).toFixed(1)) + " %";
  const size = Math.abs(value);
  if (size >= 1e5 || (size > 0 && size < 1e-3)) return value.toExponential(2).replace(/\.?0*e\+?/, "e");
  return String(Number(value.toPrecision(4)));
}

// From values to pixels. `known` are values that deserve a tick of their own, as the error scales do.
class Scale {
  constructor(axis, log, values, from, to, known) {
    Object.assign(this, { log, from, to });
    const held = values.filter((value) => this.holds(value)).map((value) => (log ? Math.log10(value) : value));
    const low = Math.min(...held), high = Math.max(...held), margin = 0.06 * (high - low) || 0.5;
    const ends = axis.share && !log ? [-0.03, 1.03] : held.length ? [low - margin, high + margin] : [0, 1];
    [this.low, this.high] = log ? ends.map((end) => Math.pow(10, end)) : ends;
    this.ticks = (known ? this.spread(known) : log ? this.decades() : this.steps()).filter(
      (value) => value >= this.low && value <= this.high);
  }

  holds(value) { return value !== null && value !== undefined && (!this.log || value > 0); }

  place(value) {
    const way = this.log ? Math.log(value / this.low) / Math.log(this.high / this.low)
      : (value - this.low) / (this.high - this.low);
    return this.from + way * (this.to - this.from);
  }

  spread(values) {
    const kept = [];
    for (const value of Array.from(new Set(values)).filter((v) => this.holds(v)).sort((a, b) => a - b)) {
      if (!kept.length || Math.abs(this.place(value) - this.place(kept[kept.length - 1])) > 34) kept.push(value);
    }
    return kept;
  }

  decades() {
    const first = Math.floor(Math.log10(this.low)), apart = Math.ceil((Math.log10(this.high) - first) / 7);
    const steps = this.high / this.low < 1e3 ? [1, 2, 5] : [1];
    return Array.from({ length: 8 }, (_, k) => steps.map((step) => Number(step + "e" + (first + k * apart)))).flat();
  }

  steps() {
    const rough = (this.high - this.low) / 6, size = Math.pow(10, Math.floor(Math.log10(rough)));
    const step = [1, 2, 5, 10].map((k) => k * size).find((s) => s >= rough), first = Math.ceil(this.low / step);
    return Array.from({ length: 12 }, (_, k) => Number(((first + k) * step).toPrecision(12)));
  }
}

// Outlines of markers within a unit circle, by the letters that matplotlib has for them.
function polygon(corners, turn) {
  return Array.from({ length: corners }, function (_, k) {
    const angle = 2 * Math.PI * k / corners + turn;
    return [Math.sin(angle), -Math.cos(angle)];
  });
}

const STAR = (turn) => polygon(8, turn).map(([x, y], k) => (k % 2 ? [0.4 * x, 0.4 * y] : [x, y]));
const OUTLINES = {
  "s": polygon(4, Math.PI / 4), "D": polygon(4, 0), "d": polygon(4, 0).map(([x, y]) => [0.6 * x, y]),
  "^": polygon(3, 0), "v": polygon(3, Math.PI), "<": polygon(3, -Math.PI / 2), ">": polygon(3, Math.PI / 2),
  "p": polygon(5, 0), "h": polygon(6, 0), "P": STAR(0), "X": STAR(Math.PI / 4),
};

function marker(kind, x, y, radius) {
  const outline = OUTLINES[kind];
  if (!outline) return shape("circle", { cx: x, cy: y, r: radius * 0.9 });
  const points = outline.map(([a, b]) => (x + radius * a).toFixed(1) + "," + (y + radius * b).toFixed(1));
  return shape("polygon", { points: points.join(" ") });
}

class Chart {
  constructor(place) {
    this.data = JSON.parse(place.dataset.chart);
    this.hidden = new Set();
    this.at = null;  // the point that is spoken of
    this.place = place;
    this.plot = shape("svg", { tabindex: 0, role: "group", "aria-label": place.dataset.title +
      ". Arrow keys go from point to point: left and right along a curve, up and down between curves." });
    this.note = element("div", { class: "note", role: "status", hidden: "" });
    place.append(this.controls(), element("div", { class: "plot" }, this.plot, this.note), this.legend());
    for (const kind of ["pointermove", "pointerdown"]) this.plot.addEventListener(kind, (event) => this.point(event));
    for (const kind of ["pointerleave", "blur"]) this.plot.addEventListener(kind, () => this.tell(null));
    this.plot.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => { if (place.clientWidth !== this.width) this.draw(); }).observe(place);
  }

  controls() {
    const bar = element("div", { class: "controls" });
    for (const [name, says] of [["y", "Up"], ["x", "Across"]]) {
      const axes = this.data[name];
      const choice = element("select", {}, ...axes.map((axis, k) => element("option", { value: k }, axis.title)));
      const log = element("input", { type: "checkbox" });
      const choose = () => { this[name] = axes[choice.value]; log.checked = this[name].log; };
      choice.addEventListener("change", () => { choose(); this.draw(); });
      log.addEventListener("change", () => this.draw());
      this[name + "Log"] = log;
      choose();
      bar.append(element("span", {}, element("label", {}, says + " ", choice), element("label", {}, log, " log")));
    }
    return bar;
  }

  legend() {
    return element("div", { class: "legend" }, ...this.data.series.map((series) => {
      const sample = shape("svg", { width: 30, height: 14, "aria-hidden": "true" }, this.line(series, "M1 7H29"),
        marker(series.marker, 15, 7, 5));
      const button = this.paint(element("button", { type: "button", "aria-pressed": "true" }, sample, series.name), series);
      button.addEventListener("click", () => {
        if (!this.hidden.delete(series)) this.hidden.add(series);
        button.setAttribute("aria-pressed", String(!this.hidden.has(series)));
        this.draw();
      });
      return button;
    }));
  }

  paint(node, series) {
    node.classList.add("series");
    node.style.setProperty("--on-light", series.color);
    node.style.setProperty("--on-dark", series.on_dark);
    return node;
  }

  line(series, path) {
    return shape("path", { d: path, class: "line", "stroke-dasharray": series.dash.map((v) => v * 1.5).join(" ") });
  }

  get shown() { return this.data.series.filter((series) => !this.hidden.has(series)); }

  draw() {
    this.width = this.place.clientWidth;
    const width = Math.max(280, this.width), height = Math.round(Math.min(420, 180 + width * 0.28));
    const all = (axis, names) => this.shown.flatMap((series) => names.flatMap((name) => series.values[axis[name]] || []));
    const known = this.x.column === "error_scale" ? all(this.x, ["column"]) : null;
    this.across = new Scale(this.x, this.xLog.checked, all(this.x, ["column"]), MARGIN.left, width - MARGIN.right, known);
    this.up = new Scale(this.y, this.yLog.checked, [...all(this.y, ["column", "low", "high"]), this.y.reference],
      height - MARGIN.bottom, MARGIN.top, null);
    this.points = this.shown.flatMap((series) => this.pointsOf(series));
    this.plot.setAttribute("viewBox", "0 0 " + width + " " + height);
    this.plot.style.height = height + "px";
    this.plot.replaceChildren(this.frame(width, height), ...this.shown.map((series) => this.curve(series)));
    this.tell(null);
  }

  pointsOf(series) {
    const x = series.values[this.x.column], y = series.values[this.y.column];
    return x.map((_, k) => k).filter((k) => this.across.holds(x[k]) && this.up.holds(y[k]))
      .map((k) => ({ series, k, x: this.across.place(x[k]), y: this.up.place(y[k]) }));
  }

  frame(width, height) {
    const left = MARGIN.left, right = width - MARGIN.right, bottom = height - MARGIN.bottom, top = MARGIN.top;
    const parts = shape("g", { class: "frame" });
    for (const tick of this.across.ticks) {
      const x = this.across.place(tick);
      parts.append(shape("path", { d: `M${x} ${top}V${bottom}`, class: "grid" }),
        shape("text", { x, y: bottom + 16, "text-anchor": "middle" }, written(tick, this.x.share)));
    }
    for (const tick of this.up.ticks) {
      const y = this.up.place(tick);
      parts.append(shape("path", { d: `M${left} ${y}H${right}`, class: "grid" }),
        shape("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, written(tick, this.y.share)));
    }
    const y = this.up.holds(this.y.reference) ? this.up.place(this.y.reference) : -99;
    parts.append(shape("path", { d: `M${left} ${y}H${right}`, class: "reference" }),
      shape("text", { x: right - 4, y: y - 4, "text-anchor": "end", class: "says" }, this.y.reference_title));
    const turned = "translate(14 " + (top + bottom) / 2 + ") rotate(-90)";
    parts.append(
      shape("path", { d: `M${left} ${top}V${bottom}H${right}`, class: "edge" }),
      shape("text", { x: (left + right) / 2, y: height - 8, "text-anchor": "middle", class: "name" }, this.x.title),
      shape("text", { transform: turned, "text-anchor": "middle", class: "name" }, this.y.title));
    return parts;
  }

  curve(series) {
    const points = this.points.filter((point) => point.series === series);
    // The line breaks where a value is missing.
    const path = points.map((point, i) =>
      (i && points[i - 1].k === point.k - 1 ? "L" : "M") + point.x.toFixed(1) + " " + point.y.toFixed(1));
    const group = this.paint(shape("g", {}, this.line(series, path.join(""))), series);
    for (const point of points) {
      const few = series.values.trials[point.k] < this.data.few;
      const ends = ["low", "high"].map((end) => this.value(point, end));
      if (!few && ends.every((end) => this.up.holds(end))) {
        const [from, to] = ends.map((end) => this.up.place(end));
        group.append(shape("path", { d: `M${point.x} ${from}V${to}`, class: "bar" }));
      }
      point.mark = marker(series.marker, point.x, point.y, 4.5);
      if (few) point.mark.classList.add("hollow");
      group.append(point.mark);
    }
    return group;
  }

  value(point, name) { const values = point.series.values[this.y[name]]; return values ? values[point.k] : null; }

  point(event) {
    const box = this.plot.getBoundingClientRect();
    const distance = (p) => Math.hypot(p.x - (event.clientX - box.left), p.y - (event.clientY - box.top));
    const nearest = this.points.reduce((best, p) => (!best || distance(p) < distance(best) ? p : best), null);
    this.tell(nearest && distance(nearest) < 40 ? nearest : null);
  }

  key(event) {
    const along = { ArrowRight: 1, ArrowLeft: -1 }[event.key], between = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if ((!along && !between) || !this.points.length) return;
    event.preventDefault();
    if (!this.at) { this.tell(this.points[0]); return; }
    const next = (list, item, step) => list[(list.indexOf(item) + step + list.length) % list.length];
    const of = (series) => this.points.filter((p) => p.series === series);
    if (along) { this.tell(next(of(this.at.series), this.at, along)); return; }
    const there = of(next(this.shown.filter((series) => of(series).length), this.at.series, between));
    this.tell(there.reduce((best, p) => (Math.abs(p.x - this.at.x) < Math.abs(best.x - this.at.x) ? p : best)));
  }

  tell(point) {
    if (this.at) this.at.mark.classList.remove("told");
    this.at = point;
    this.note.hidden = !point;
    if (!point) return;
    point.mark.classList.add("told");
    const says = (axis) => axis.title + ": " + written(point.series.values[axis.column][point.k], axis.share);
    const low = this.value(point, "low"), interval = low === null ? ""
      : " (" + written(low, this.y.share) + " to " + written(this.value(point, "high"), this.y.share) + ")";
    this.note.replaceChildren(element("b", {}, point.series.name), element("span", {}, says(this.y) + interval),
      ...this.data.x.map((axis) => element("span", {}, says(axis))),
      element("span", {}, point.series.values.trials[point.k] + " trials"));
    this.note.style.left = Math.max(0, Math.min(point.x + 12, this.place.clientWidth - this.note.offsetWidth)) + "px";
    this.note.style.top = point.y + (point.y > 130 ? -12 - this.note.offsetHeight : 14) + "px";
  }
}

document.querySelectorAll(".chart").forEach((place) => new Chart(place));
unfold();
