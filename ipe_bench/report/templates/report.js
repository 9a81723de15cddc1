"use strict";

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
      table.querySelectorAll("th").forEach(function (other) { other.removeAttribute("aria-sort"); });
      th.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = Array.from(body.rows);
      rows.sort(function (a, b) {
        const x = a.cells[column], y = b.cells[column];
        const order = x.dataset.key === undefined || y.dataset.key === undefined
          ? x.textContent.localeCompare(y.textContent, "en", { numeric: true })
          : Math.sign(Number(x.dataset.key) - Number(y.dataset.key)) || 0;
        return down ? -order : order;
      });
      rows.forEach(function (row) { body.appendChild(row); });
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
      const cells = Array.from(row.cells, function (cell) { return cell.textContent.toLowerCase(); });
      // A number is looked for as a whole cell, a word anywhere: "1" does not find 100.
      const hit = words.every(function (word) {
        return cells.some(function (cell) { return isNaN(Number(word)) ? cell.includes(word) : cell === word; });
      });
      row.hidden = !hit;
      shown += hit ? 1 : 0;
    });
    count.textContent = words.length ? shown + " of " + rows.length + " rows" : rows.length + " rows";
  });
});

// Charts: each is drawn from the numbers that stand beside it, again whenever its width or an answer to one of its
// controls changes. Nothing is fetched, and texts are set as texts.

const MARGIN = { top: 10, right: 14, bottom: 44, left: 62 };
const NEAR = 6;  // pixels within which markers lie upon each other

function element(name, attributes, ...children) {
  return filled(document.createElement(name), attributes, children);
}

function shape(name, attributes, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

function written(value, share) {
  if (value === null) return "-";
  if (share) return Number((100 * value).toFixed(1)) + " %";
  const size = Math.abs(value);
  if (size >= 1e5 || (size > 0 && size < 1e-3)) return value.toExponential(2).replace("e+", "e");
  return String(Number(value.toPrecision(4)));
}

const RAISED = { "-": "\u207b", 0: "\u2070", 1: "\u00b9", 2: "\u00b2", 3: "\u00b3", 4: "\u2074", 5: "\u2075",
  6: "\u2076", 7: "\u2077", 8: "\u2078", 9: "\u2079" };

function tickText(value, share) {
  const power = Math.log10(value);
  if (share || !Number.isInteger(power) || Math.abs(power) < 5) return written(value, share);
  return "10" + Array.from(String(power), (sign) => RAISED[sign]).join("");
}

// From values to pixels. `known` are values that deserve a tick of their own, as the error scales do.
class Scale {
  constructor(axis, log, values, ends, from, to, known) {
    this.log = log;
    this.from = from;
    this.to = to;
    const held = (list) => list.filter((value) => this.holds(value));
    [this.low, this.high] = axis.share && !log ? [-0.03, 1.03] : this.limits(held(values), held(ends));
    this.ticks = (known ? this.spread(known) : log ? this.decades() : this.steps()).filter(
      (value) => value >= this.low && value <= this.high);
  }

  holds(value) { return value !== null && (!this.log || value > 0); }

  // Around the values, with the ends of their intervals as far as these leave the values room.
  limits(values, ends) {
    if (!values.length) return this.log ? [0.1, 10] : [0, 1];
    const way = this.log ? Math.log10 : Number, back = this.log ? (v) => Math.pow(10, v) : Number;
    const low = way(Math.min(...values)), high = way(Math.max(...values));
    const room = 0.3 * (high - low) || (this.log ? 0.1 : 0.1 * Math.abs(high) || 1);
    const lowest = Math.max(low - room, Math.min(low, ...ends.map(way)));
    const highest = Math.min(high + room, Math.max(high, ...ends.map(way)));
    const margin = 0.05 * (highest - lowest) || room;
    return [back(lowest - margin), back(highest + margin)];
  }

  within(value) { return Math.min(this.high, Math.max(this.low, value)); }

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
    const first = Math.floor(Math.log10(this.low)), last = Math.ceil(Math.log10(this.high));
    const apart = Math.ceil((last - first) / 7);
    const steps = last - first <= 3 ? [1, 2, 5] : [1];
    const ticks = [];
    for (let power = first; power <= last; power += apart) {
      for (const step of steps) ticks.push(Number((step * Math.pow(10, power)).toPrecision(1)));
    }
    return ticks;
  }

  steps() {
    const rough = (this.high - this.low) / 6, size = Math.pow(10, Math.floor(Math.log10(rough)));
    const step = [1, 2, 5, 10].map((k) => k * size).find((s) => s >= rough);
    const ticks = [];
    for (let k = Math.ceil(this.low / step); k * step <= this.high; k++) ticks.push(Number((k * step).toPrecision(12)));
    return ticks;
  }
}

// Outlines of markers within a unit circle, by the letters that matplotlib has for them.
function polygon(corners, turn) {
  return Array.from({ length: corners }, function (_, k) {
    const angle = 2 * Math.PI * k / corners + turn;
    return [Math.sin(angle), -Math.cos(angle)];
  });
}

const SQUARE = polygon(4, Math.PI / 4), DIAMOND = polygon(4, 0);
const PLUS = [[-.35, -1], [.35, -1], [.35, -.35], [1, -.35], [1, .35], [.35, .35], [.35, 1], [-.35, 1], [-.35, .35],
  [-1, .35], [-1, -.35], [-.35, -.35]];
const OUTLINES = {
  "s": SQUARE, "D": DIAMOND, "d": DIAMOND.map(([x, y]) => [0.6 * x, y]), "^": polygon(3, 0), "v": polygon(3, Math.PI),
  "<": polygon(3, -Math.PI / 2), ">": polygon(3, Math.PI / 2), "p": polygon(5, 0), "h": polygon(6, 0), "P": PLUS,
  "X": PLUS.map(([x, y]) => [(x - y) * Math.SQRT1_2, (x + y) * Math.SQRT1_2]),
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
    this.note = element("div", { class: "note", role: "status" });
    this.note.hidden = true;
    place.append(this.controls(), element("div", { class: "plot" }, this.plot, this.note), this.legend());
    this.plot.addEventListener("pointermove", (event) => this.point(event));
    this.plot.addEventListener("pointerdown", (event) => this.point(event));
    this.plot.addEventListener("pointerleave", () => this.tell(null));
    this.plot.addEventListener("blur", () => this.tell(null));
    this.plot.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => { if (place.clientWidth !== this.width) this.draw(); }).observe(place);
  }

  // Controls

  controls() {
    const bar = element("div", { class: "controls" });
    for (const [name, says] of [["y", "Up"], ["x", "Across"]]) {
      const axes = this.data[name];
      const choice = element("select", {}, ...axes.map((axis, k) => element("option", { value: k }, axis.title)));
      const log = element("input", { type: "checkbox" });
      const choose = () => {
        this[name] = axes[choice.value];
        log.checked = this[name].log;
      };
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
      const button = element("button", { type: "button", "aria-pressed": "true" }, sample, series.name);
      this.paint(button, series);
      button.addEventListener("click", () => {
        const show = this.hidden.has(series);
        if (show) this.hidden.delete(series);
        else this.hidden.add(series);
        button.setAttribute("aria-pressed", String(show));
        this.draw();
      });
      return button;
    }));
  }

  paint(node, series) {
    node.classList.add("series");
    node.style.setProperty("--on-light", series.color);
    node.style.setProperty("--on-dark", series.on_dark);
  }

  line(series, path) {
    return shape("path", { d: path, class: "line", "stroke-dasharray": series.dash.map((v) => v * 1.5).join(" ") });
  }

  // Drawing

  get shown() { return this.data.series.filter((series) => !this.hidden.has(series)); }

  draw() {
    this.width = this.place.clientWidth;
    const width = Math.max(280, this.width), height = Math.round(Math.min(420, 180 + width * 0.28));
    const all = (axis, names) => this.shown.flatMap((series) => names.flatMap((name) => series.values[axis[name]] || []));
    const reference = this.y.reference === null ? [] : [this.y.reference];
    const scales = this.x.column === "error_scale" ? all(this.x, ["column"]) : null;
    this.across = new Scale(this.x, this.xLog.checked, all(this.x, ["column"]), [], MARGIN.left, width - MARGIN.right,
      scales);
    this.up = new Scale(this.y, this.yLog.checked, [...all(this.y, ["column"]), ...reference],
      all(this.y, ["low", "high"]), height - MARGIN.bottom, MARGIN.top, null);
    this.points = this.shown.flatMap((series) => this.pointsOf(series));
    this.points.forEach((point) => { point.depth = this.points.filter((other) => this.lies(other, point)).length; });
    this.plot.setAttribute("viewBox", "0 0 " + width + " " + height);
    this.plot.style.height = height + "px";
    this.plot.replaceChildren(this.frame(width, height), ...this.shown.map((series) => this.curve(series)));
    this.tell(null);
  }

  pointsOf(series) {
    const of = (axis) => series.values[axis.column];
    return of(this.x).map((_, k) => k)
      .filter((k) => this.across.holds(of(this.x)[k]) && this.up.holds(of(this.y)[k]))
      .map((k) => ({ series, k, x: this.across.place(of(this.x)[k]), y: this.up.place(of(this.y)[k]) }));
  }

  lies(other, point) {
    const later = this.data.series.indexOf(other.series) > this.data.series.indexOf(point.series);
    return later && Math.abs(other.x - point.x) < NEAR && Math.abs(other.y - point.y) < NEAR;
  }

  frame(width, height) {
    const left = MARGIN.left, right = width - MARGIN.right, bottom = height - MARGIN.bottom;
    const parts = shape("g", { class: "frame" });
    for (const tick of this.across.ticks) {
      const x = this.across.place(tick);
      parts.append(shape("path", { d: "M" + x + " " + MARGIN.top + "V" + bottom, class: "grid" }),
        shape("text", { x, y: bottom + 16, "text-anchor": "middle" }, tickText(tick, this.x.share)));
    }
    for (const tick of this.up.ticks) {
      const y = this.up.place(tick);
      parts.append(shape("path", { d: "M" + left + " " + y + "H" + right, class: "grid" }),
        shape("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, tickText(tick, this.y.share)));
    }
    if (this.up.holds(this.y.reference)) {
      const y = this.up.place(this.y.reference);
      parts.append(shape("path", { d: "M" + left + " " + y + "H" + right, class: "reference" }),
        shape("text", { x: right - 4, y: y - 4, "text-anchor": "end", class: "says" }, this.y.reference_title));
    }
    const middle = (MARGIN.top + bottom) / 2;
    parts.append(
      shape("path", { d: "M" + left + " " + MARGIN.top + "V" + bottom + "H" + right, class: "edge" }),
      shape("text", { x: (left + right) / 2, y: height - 8, "text-anchor": "middle", class: "name" }, this.x.title),
      shape("text", { transform: "translate(14 " + middle + ") rotate(-90)", "text-anchor": "middle", class: "name" },
        this.y.title));
    return parts;
  }

  curve(series) {
    const group = shape("g", {});
    const points = this.points.filter((point) => point.series === series);
    // The line breaks where a value is missing.
    const path = points.map((point, i) =>
      (i && points[i - 1].k === point.k - 1 ? "L" : "M") + point.x.toFixed(1) + " " + point.y.toFixed(1));
    this.paint(group, series);
    group.append(this.line(series, path.join("")));
    for (const point of points) {
      const few = this.count(point) < this.data.few;
      const low = this.value(point, "low"), high = this.value(point, "high");
      if (!few && this.up.holds(low) && this.up.holds(high)) {
        const [from, to] = [low, high].map((end) => this.up.place(this.up.within(end)));
        group.append(shape("path", { d: "M" + point.x + " " + from + "V" + to, class: "bar" }));
      }
      point.mark = marker(series.marker, point.x, point.y, 4.5 + Math.min(1.6 * point.depth, 7));
      if (few) point.mark.classList.add("hollow");
      group.append(point.mark);
    }
    return group;
  }

  // What is pointed at

  value(point, name) { const values = point.series.values[this.y[name]]; return values ? values[point.k] : null; }

  count(point) { return point.series.values[this.y.count][point.k]; }

  point(event) {
    const box = this.plot.getBoundingClientRect();
    const distance = (p) => Math.hypot(p.x - (event.clientX - box.left), p.y - (event.clientY - box.top));
    const nearest = this.points.reduce((best, p) => (!best || distance(p) < distance(best) ? p : best), null);
    this.tell(nearest && distance(nearest) < 40 ? nearest : null);
  }

  key(event) {
    const along = { ArrowRight: 1, ArrowLeft: -1 }[event.key], between = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (event.key === "Escape") this.tell(null);
    if ((!along && !between) || !this.points.length) return;
    event.preventDefault();
    if (!this.at) { this.tell(this.points[0]); return; }
    const own = this.points.filter((p) => p.series === this.at.series);
    const others = this.shown.filter((series) => this.points.some((p) => p.series === series));
    const next = (list, item, step) => list[(list.indexOf(item) + step + list.length) % list.length];
    if (along) { this.tell(next(own, this.at, along)); return; }
    const there = this.points.filter((p) => p.series === next(others, this.at.series, between));
    this.tell(there.reduce((best, p) => (Math.abs(p.x - this.at.x) < Math.abs(best.x - this.at.x) ? p : best)));
  }

  tell(point) {
    if (this.at) this.at.mark.classList.remove("told");
    this.at = point;
    this.note.hidden = !point;
    if (!point) return;
    point.mark.classList.add("told");
    const says = (axis, name) => written(point.series.values[axis[name]][point.k], axis.share);
    const low = this.value(point, "low"), interval = low === null ? ""
      : " (" + written(low, this.y.share) + " to " + written(this.value(point, "high"), this.y.share) + ")";
    const trials = point.series.values.trials[point.k], count = this.count(point);
    this.note.replaceChildren(element("b", {}, point.series.name),
      element("span", {}, this.y.title + ": " + says(this.y, "column") + interval),
      ...this.data.x.map((axis) => element("span", {}, axis.title + ": " + says(axis, "column"))),
      element("span", {}, (count < trials ? count + " of " + trials : trials) + " trials"));
    const room = this.place.clientWidth - this.note.offsetWidth;
    this.note.style.left = Math.max(0, Math.min(point.x + 12, room)) + "px";
    this.note.style.top = point.y + (point.y > 130 ? -12 - this.note.offsetHeight : 14) + "px";
  }
}

document.querySelectorAll(".chart").forEach(function (place) {
  new Chart(place);
  place.parentElement.classList.add("answers");
});
document.querySelectorAll(".answers").forEach(function (figure) {
  const picture = figure.querySelector(".static");
  if (!picture) return;
  const button = element("button", { type: "button", class: "plain", "aria-expanded": "false" }, "Show the static figure");
  button.addEventListener("click", function () {
    const open = figure.classList.toggle("with-static");
    button.setAttribute("aria-expanded", String(open));
    button.textContent = open ? "Hide the static figure" : "Show the static figure";
  });
  picture.before(button);
});
