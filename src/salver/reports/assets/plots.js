// Interactive SVG charts with one shared time cursor. No dependencies.
"use strict";

const SVG = "http://www.w3.org/2000/svg";

function svg(name, attributes = {}, parent = null, text = null) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  if (parent) parent.appendChild(element);
  return element;
}

// Round ticks that cover [low, high], about `count` of them.
function ticks(low, high, count = 5) {
  const raw = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((x) => x * power).find((x) => x >= raw * 0.999);
  const out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-12 * step ? 0 : v);
  return out;
}

function tickLabels(values) {
  const step = values.length > 1 ? values[1] - values[0] : values[0] || 1, largest = Math.max(...values.map(Math.abs), step);
  if (largest >= 1e5 || (largest < 1e-3 && largest > 0)) return values.map((v) => (v === 0 ? "0" : v.toExponential(1).replace("e", "·10^").replace("+", "")));
  const digits = Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9) + (Math.abs(step * 10 ** -Math.floor(Math.log10(step)) - 2.5) < 1e-6 ? 1 : 0)));
  return values.map((v) => v.toFixed(digits).replace("-", "−"));
}

function shown(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size < 1e-9 ? "0" : size >= 1e4 || size < 1e-3 ? value.toExponential(2) : size >= 999.5 ? value.toFixed(0) : value.toPrecision(3);
  return text.replace("-", "−");
}

function interpolate(x, y, at) {
  if (at < x[0] || at > x[x.length - 1]) return NaN;
  const [i, u] = locate(x, at);
  if (y[i] === null || (u > 0 && y[i + 1] === null)) return NaN;
  return u > 0 ? (1 - u) * y[i] + u * y[i + 1] : y[i];
}

const redraws = [];  // every chart's drawing function
const PRINT_WIDTH = 400;  // drawn this wide for print, where two charts share a page: text stays legible

function redrawAll(forPrint) {
  redraws.printing = forPrint;
  for (const draw of redraws) draw();
}

// Calls draw now, when the host changes its width, and when the page is printed.
function drawn(host, draw) {
  redraws.push(draw);
  draw();
  let width = host.clientWidth;
  new ResizeObserver(() => {
    if (redraws.printing || Math.abs(width - host.clientWidth) < 1) return;
    width = host.clientWidth;
    draw();
  }).observe(host);
}

const widthOf = (host) => (redraws.printing ? PRINT_WIDTH : Math.max(260, host.clientWidth));

const cursors = [];  // every time chart's function that moves its cursor

function setCursor(t) {
  for (const move of cursors) move(t);
}

// spec: {x: label, y: label, series: [{name, colour, dash, width, x, y, quiet}], bands: [{x, low, high, colour}],
//        lines: [{y, label, colour}], range: [low, high] or null, time: true when x is time}
function chart(host, spec, onTime) {
  const draw = () => {
    host.replaceChildren();
    const width = widthOf(host), height = spec.height || 210;
    const box = { left: 66, right: width - 14, top: 10, bottom: height - 38 };
    const image = svg("svg", { viewBox: `0 0 ${width} ${height}`, width: "100%", role: "img", "aria-label": `${spec.y} over ${spec.x}` }, host);
    const xs = [...spec.series, ...(spec.bands || [])].flatMap((s) => [s.x[0], s.x[s.x.length - 1]]);
    const xRange = [Math.min(...xs), Math.max(...xs)], yRange = spec.range || extent(spec);
    const X = (v) => box.left + ((v - xRange[0]) / (xRange[1] - xRange[0] || 1)) * (box.right - box.left);
    const Y = (v) => box.bottom - ((v - yRange[0]) / (yRange[1] - yRange[0] || 1)) * (box.bottom - box.top);
    axes(image, box, xRange, yRange, X, Y, spec);
    const id = `clip${(chart.count = (chart.count || 0) + 1)}`;
    svg("rect", { x: box.left, y: box.top - 1, width: box.right - box.left, height: box.bottom - box.top + 2 }, svg("clipPath", { id }, svg("defs", {}, image)));
    const inside = svg("g", { "clip-path": `url(#${id})` }, image);
    // null: a gap in a measurement.
    const path = (x, y) => x.map((v, i) => (y[i] === null ? "" : `${i && y[i - 1] !== null ? "L" : "M"}${X(v).toFixed(1)} ${Y(y[i]).toFixed(1)}`)).join("");
    for (const band of spec.bands || []) {
      const back = [...band.x].reverse(), low = [...band.low].reverse();
      svg("path", { d: path(band.x, band.high) + path(back, low).replace("M", "L") + "Z", fill: band.colour, opacity: band.opacity || 0.16 }, inside);
    }
    for (const line of spec.lines || [])
      svg("line", { x1: box.left, x2: box.right, y1: Y(line.y), y2: Y(line.y), stroke: line.colour || "var(--axis)", "stroke-dasharray": "5 4" }, inside);
    for (const s of spec.series)
      svg("path", { d: path(s.x, s.y), fill: "none", class: "series", stroke: s.colour, "stroke-width": s.width || 1.8, "stroke-dasharray": s.dash || "none", "stroke-linejoin": "round", opacity: s.opacity || 1 }, inside);
    for (const line of spec.lines || [])  // last: no curve runs through a word
      if (line.label) svg("text", { x: box.right - 4, y: Y(line.y) + (line.below ? 13 : -5), "text-anchor": "end", class: "note named", fill: line.colour || "var(--soft)" }, image, line.label);
    if (spec.time) attachCursor(host, image, box, xRange, X, Y, spec, onTime);
  };
  drawn(host, draw);
  return draw;
}

function extent(spec) {
  let low = Infinity, high = -Infinity;
  const add = (values) => {
    for (const v of values)
      if (v !== null && Number.isFinite(v)) [low, high] = [Math.min(low, v), Math.max(high, v)];
  };
  for (const s of spec.series) add(s.y);
  for (const b of spec.bands || []) [b.low, b.high].forEach(add);
  for (const l of spec.lines || []) add([l.y]);
  if (spec.zero) add([0]);
  if (!Number.isFinite(low)) return [0, 1];
  const pad = 0.06 * (high - low) || Math.abs(high) * 0.1 || 1;
  return [spec.zero && low === 0 ? 0 : low - pad, high + pad];
}

function axes(image, box, xRange, yRange, X, Y, spec) {
  const across = ticks(xRange[0], xRange[1], (box.right - box.left) / 90), up = ticks(yRange[0], yRange[1], 5);
  tickLabels(up).forEach((label, i) => {
    svg("line", { x1: box.left, x2: box.right, y1: Y(up[i]), y2: Y(up[i]), stroke: up[i] === 0 ? "var(--zero)" : "var(--grid)" }, image);
    svg("text", { x: box.left - 7, y: Y(up[i]) + 4, "text-anchor": "end", class: "tick" }, image, label);
  });
  tickLabels(across).forEach((label, i) => {
    svg("line", { x1: X(across[i]), x2: X(across[i]), y1: box.bottom, y2: box.bottom + 4, stroke: "var(--axis)" }, image);
    svg("text", { x: X(across[i]), y: box.bottom + 17, "text-anchor": "middle", class: "tick" }, image, label);
  });
  svg("line", { x1: box.left, x2: box.right, y1: box.bottom, y2: box.bottom, stroke: "var(--axis)" }, image);
  svg("text", { x: (box.left + box.right) / 2, y: box.bottom + 33, "text-anchor": "middle", class: "label" }, image, spec.x);
  svg("text", { transform: `translate(12 ${(box.top + box.bottom) / 2}) rotate(-90)`, "text-anchor": "middle", class: "label" }, image, spec.y);
}

function attachCursor(host, image, box, xRange, X, Y, spec, onTime) {
  const line = svg("line", { y1: box.top, y2: box.bottom, stroke: "var(--ink)", "stroke-width": 1, opacity: 0.45, class: "cursor" }, image);
  const named = spec.series.filter((s) => s.name && !s.quiet);
  const dots = named.map((s) => svg("circle", { r: 3, fill: s.colour, stroke: "var(--paper)", class: "cursor" }, image));
  const values = host.closest("figure")?.querySelectorAll("[data-value]") || [];
  const move = (t) => {
    line.setAttribute("x1", X(t));
    line.setAttribute("x2", X(t));
    line.setAttribute("visibility", t < xRange[0] - 1e-9 || t > xRange[1] + 1e-9 ? "hidden" : "visible");
    named.forEach((s, i) => {
      const y = interpolate(s.x, s.y, Math.max(xRange[0], Math.min(xRange[1], t))), visible = Number.isFinite(y);
      dots[i].setAttribute("visibility", visible ? "visible" : "hidden");
      if (visible) [["cx", X(t)], ["cy", Y(y)]].forEach(([key, v]) => dots[i].setAttribute(key, v));
      if (values[i]) values[i].textContent = shown(y) + (visible ? values[i].dataset.unit : "");
    });
  };
  if (host.cursor) cursors.splice(cursors.indexOf(host.cursor), 1);
  host.cursor = move;
  cursors.push(move);
  const timeAt = (event) => {
    const bounds = image.getBoundingClientRect(), x = ((event.clientX - bounds.left) / bounds.width) * image.viewBox.baseVal.width;
    return xRange[0] + ((x - box.left) / (box.right - box.left)) * (xRange[1] - xRange[0]);
  };
  image.style.cursor = "crosshair";
  image.addEventListener("pointermove", (event) => onTime(Math.max(xRange[0], Math.min(xRange[1], timeAt(event)))));
  move(chart.time || 0);
}

// Least and largest of curves that may have gaps.
function extremes(curves, unit) {
  const values = curves.flat().filter((v) => v !== null && Number.isFinite(v));
  return values.length ? `${shown(Math.min(...values))} to ${shown(Math.max(...values))}${unit}` : "";
}

// Legend above a chart: one entry a named series, with its extremes and the value under the cursor.
function legend(host, spec) {
  const unit = spec.unit ? ` ${spec.unit}` : "", quiet = spec.series.filter((s) => s.quiet);
  if (quiet.length) host.append(`lines ${extremes(quiet.map((s) => s.y), unit)} · tubes ${extremes((spec.bands || []).flatMap((b) => [b.low, b.high]), unit)}`);
  for (const s of spec.series.filter((x) => x.name && !x.quiet)) {
    const entry = document.createElement("span");
    const image = svg("svg", { width: 22, height: 8, "aria-hidden": "true" }, entry);
    svg("line", { x1: 0, x2: 22, y1: 4, y2: 4, stroke: s.colour, "stroke-width": s.width ? 1.2 : 2.4, "stroke-dasharray": s.dash || "none", opacity: s.opacity || 1 }, image);
    entry.append(` ${s.name} `);
    if (spec.time) {
      const range = document.createElement("span");
      range.className = "range";
      range.textContent = `(${extremes([s.y], unit)})`;
      entry.append(range, " ");
      const value = document.createElement("b");
      value.dataset.value = "";
      value.dataset.unit = unit;
      entry.append(value);
    }
    host.append(entry);
  }
}
