// The studio: a text is changed by hand, by sliders or as text; what is known of it comes back with each change. All
// that stands at the top of the page is said by salver. The live mode is in live.js.
"use strict";

const given = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const here = location.pathname.replace(/\/?$/, "/");
const own = crypto.randomUUID();  // this window
const COLOURS = { start: [0.0, 0.45, 0.7, 1], goal: [0.84, 0.37, 0.0, 1], tray: [0.0, 0.62, 0.45, 1], objects: [0.9, 0.62, 0.0, 1], obstacles: [0.35, 0.38, 0.42, 1] };
const coarse = inSoftware();
const RING = 0.04;  // m, within which a ring is taken hold of
const state = { text: given.text, saved: null, mistakes: [], answer: null, verdict: null, plan: null, planning: null, said: "", done: [], undone: [], chosen: "goal", leg: 0, time: 0, speed: 1, playing: false, gesture: null, base: "", viewer: null, looks: 0, live: null, frames: 0, held: null, keys: new Set() };

function post(does, more = {}) {
  return fetch(here + "say", { method: "POST", body: JSON.stringify({ do: does, window: own, ...more }) })
    .then((response) => response.json())
    .catch(() => ({ problem: "salver does not answer; begin it again." }));
}

// --- changes: of one gesture only the last waits, and all of them change the text as it was before the gesture

const queue = [];
let asking = false;

function edit(gesture, change) {
  if (queue.length && queue[queue.length - 1].gesture === gesture) queue.pop();
  queue.push({ gesture, ...change });
  next();
}

async function next() {
  if (asking || !queue.length) return;
  const { gesture, changes, text, typed, back, kept } = queue.shift();
  if (gesture !== state.gesture) {
    if (!back && state.answer) state.done.push(state.text);
    if (!back) state.undone.length = 0;
    [state.gesture, state.base, state.before] = [gesture, state.text, state.answer?.line];
  }
  asking = true;
  const known = state.answer ?? {};
  const answer = await post("look", { text: text ?? state.base, changes: changes ?? [], near: known.posture, arm: known.arm, leg: state.leg, coarse });
  asking = false;
  heard(answer, typed);
  if (kept) show3d(kept);
  next();
}

function heard(answer, typed) {
  state.looks += 1;
  // What a hand or a slider would make wrong stays as it was; whoever types or takes back may pass through it.
  const refused = !typed && state.mistakes.length === 0 && state.answer && answer.mistakes?.[0]?.sentence;
  state.said = answer.problem ?? refused ?? "";
  if (!answer.problem && !refused) {
    [state.text, state.mistakes, state.verdict] = [answer.text, answer.mistakes, answer.verdict];
    if (!typed) byId("text").value = answer.text;
    number();
    designing();  // what was planned of another text is no more
    if (answer.parts) show(answer);
  }
  tell();
}

function show(answer) {
  [state.answer, state.leg] = [answer, answer.legs[1]];
  byId("leg").hidden = !answer.legs[0];
  byId("leg").replaceChildren(...Array.from({ length: answer.legs[0] }, (_, k) => new Option(`leg ${k + 1}`, k, false, k === state.leg)));
  if (state.viewer) state.viewer.furnish(answer.scene);
  else begin(answer.scene);
  list();
  drawMargin(answer.line);
  if (byId("follow").checked && !answer.blocked) state.due = setTimeout(plan, 300);
  paint();
}

// From the plan back to start and goal; one that is sought is given up.
function designing() {
  clearTimeout(state.due);
  if (state.planning !== null) post("end");
  [state.plan, state.planning] = [null, null];
  halt();
  byId("clock").textContent = "";
  if (state.answer) state.viewer?.furnish({ variants: state.answer.scene.variants });
  byId("speeds").replaceChildren();
  tell();
}

async function plan() {
  clearTimeout(state.due);
  const text = state.text;
  state.planning = performance.now();
  tell();
  const found = await post("plan", { text });
  if (text !== state.text || found.ended || state.live) return;
  state.planning = null;
  state.said = found.problem ?? "";
  state.plan = found.verdict ? found : null;
  if (found.legs) show3d(found);
  tell();
}

// A plan, and of several legs the one that is looked at.
function show3d(found) {
  clearTimeout(state.due);
  state.plan = { ...found, variants: null, ...found.legs[state.leg] };
  tell();
  if (!state.plan.variants) return;
  byId("speeds").innerHTML = found.speed_bar;
  state.viewer?.furnish({ variants: state.plan.variants });
  state.time = state.plan.start;
  play(true);
}

// More of the plan: run with the straight line in the physics engine, once or a hundred times; its stops.
async function more(event) {
  const text = state.text;
  halt();
  state.said = `${event.target.textContent}: it is computed in another process.`;
  tell();
  const found = await post(event.target.id);
  if (text !== state.text || !state.plan || found.ended) return;
  state.said = found.problem ?? found.sentence;
  if (found.legs) show3d({ ...state.plan, legs: found.legs });
  tell();
}

// --- words

function tell() {
  const { plan: found, live, mistakes } = state, wrong = mistakes.length > 0;
  const now = wrong ? state.verdict : found?.verdict ?? (state.planning === null ? state.verdict : given.planning);
  const [level, head, detail] = live?.verdict ?? now ?? ["", "Looking", ""];
  byId("verdict").className = `verdict ${level}`;
  byId("says").textContent = head;
  byId("detail").textContent = [state.said, detail].filter(Boolean).join(" ");
  byId("place").textContent = given.place + (state.text === state.saved ? "" : " (not saved)");
  byId("undo").disabled = !state.done.length;
  byId("redo").disabled = !state.undone.length;
  for (const control of [byId("play"), byId("scrub"), ...document.querySelectorAll(".more")]) control.disabled = !found?.variants;
  byId("plan").disabled = wrong;
  for (const id of ["add", "chosen"]) byId(id).disabled = !state.answer;
  byId("report").hidden = !found?.variants;
  byId("report").href = `${here}report/${own}/report.html`;
  byId("export").hidden = !found?.variants || !found.ok;
}
setInterval(() => state.planning !== null && (byId("clock").textContent = `${((performance.now() - state.planning) / 1000).toFixed(0)} s`), 1000);

function number() {
  const lines = byId("text").value.split("\n").length, wrong = new Set(state.mistakes.map((m) => m.line));
  byId("gutter").replaceChildren(...Array.from({ length: lines }, (_, i) => {
    const line = document.createElement(wrong.has(i + 1) ? "b" : "span");
    line.textContent = i + 1;
    return [line, "\n"];
  }).flat());
  byId("wrong").textContent = state.mistakes.map((m) => `line ${m.line}: ${m.sentence}`).join("  ");
  scrolled();
}

function scrolled() {
  byId("gutter").scrollTop = byId("text").scrollTop;
  const line = state.mistakes[0]?.line ?? 0, top = 6 + 18 * line - byId("text").scrollTop;
  byId("wrong").style.top = `${Math.max(0, Math.min(top, byId("text").clientHeight - 24))}px`;
}

// --- the picture

const at = (p) => Mat.pose([...p, 1, 0, 0, 0]);
const rings = {};
let dragged = null;

function begin(scene) {
  const viewer = createViewer(byId("canvas"), scene), canvas = byId("canvas");
  if (!viewer) return canvas.replaceWith("This browser has no WebGL 2, so nothing can be drawn; sliders and text work.");
  state.viewer = viewer;
  const ring = Array.from({ length: 41 }, (_, i) => [RING * Math.cos((Math.PI * i) / 20), RING * Math.sin((Math.PI * i) / 20), 0]);
  rings.ring = viewer.upload(tube(ring, 0.0035));
  rings.drop = viewer.upload(revolve([[0.0015, -1], [0.0015, 0]], 8));
  rings.ball = viewer.upload(revolve(Array.from({ length: 13 }, (_, i) => [Math.sin((Math.PI * i) / 12), -Math.cos((Math.PI * i) / 12)]), 20));
  canvas.addEventListener("pointerdown", (event) => {
    const part = handleAt(event);
    if (!part) return;
    event.stopImmediatePropagation();  // not the camera's
    if (state.plan) designing();
    canvas.setPointerCapture(event.pointerId);
    dragged = { part, p: placeOf(part), gesture: {} };
    if (!state.live) choose(part.name);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (dragged) return drag(event);
    const part = event.buttons ? null : handleAt(event);
    byId("hint").textContent = part ? `${part.name}: drag${part.name === "tray" ? " the flange that holds it" : part.handle.of === "world" ? "" : " on the tray"}${lifted(part) ? ", with shift up and down" : ""}` : "drag a ring: that thing · elsewhere: turn · wheel: zoom";
  });
  canvas.addEventListener("pointerup", () => {
    if (dragged && state.held) hand({ goto: state.held });
    dragged = null;
    paint();
  });
  attachView(canvas, viewer, paint);
}

const trayPose = () => Mat.pose(state.viewer.variants[0].tray);
const placeOf = ({ handle }) => (handle.of === "world" ? handle.at : Mat.point(trayPose(), [...handle.at, 0].slice(0, 3)));
const lifted = ({ handle }) => handle.at.length === 3;  // not on the tray's surface
const handles = () => (state.live ? [goal()] : state.playing ? [] : (state.answer?.parts ?? []).filter((part) => part.handle && (part.handle.of === "world" || !state.plan?.variants)));

function handleAt(event) {
  const found = handles().map((part) => [...state.viewer.missed(event, placeOf(part)), part]).filter(([off, pixels]) => off < RING || pixels < (state.live ? 34 : 16));
  return found.sort((a, b) => a[0] - b[0])[0]?.[2] ?? null;
}

function drag(event) {
  const { part, p, gesture } = dragged, world = part.handle.of === "world", upright = event.shiftKey && lifted(part);
  const q = state.viewer.onPlane(event, p, upright);
  if (!q) return;
  dragged.p = upright ? [p[0], p[1], q[2]] : [q[0], q[1], p[2]];
  if (state.live) return wish(dragged.p);
  let value = dragged.p;
  if (!world) {
    const tray = trayPose(), d = Vec.sub(dragged.p, Mat.point(tray, [0, 0, 0]));
    value = part.handle.at.map((_, k) => k).map((k) => d[0] * tray[4 * k] + d[1] * tray[4 * k + 1] + d[2] * tray[4 * k + 2]);
  }
  edit(gesture, { changes: [[part.handle.key, value.map((x) => Number(x.toFixed(3)))]] });
  paint();
}

function paint() {
  const viewer = state.viewer;
  if (!viewer) return;
  viewer.options.layout = state.live ? (state.live.beside.length ? "side" : "single") : state.plan?.variants && !byId("beside").checked ? "single" : "overlay";
  viewer.marks.length = 0;
  for (const part of handles()) {
    const p = dragged?.part.name === part.name ? dragged.p : placeOf(part), colour = COLOURS[part.name] ?? COLOURS[part.key[0]];
    viewer.marks.push({ shape: rings.ring, model: at(p), colour, flat: true });
    if (state.live || part.name === state.chosen) viewer.marks.push({ shape: rings.drop, model: Mat.pose([...p, 1, 0, 0, 0], 0, [1, 1, Math.max(p[2] - state.answer.scene.floor || 0.3, 1e-3)]), colour: [...colour.slice(0, 3), 0.5], flat: true });
  }
  for (const ball of state.live?.balls ?? []) viewer.marks.push({ shape: rings.ball, model: Mat.pose([...ball.p, 1, 0, 0, 0], 0, Array(3).fill(ball.r)), colour: [0.8, 0.15, 0.25, 1] });
  state.stacked = viewer.render(state.time).stacked;
}

// --- playing

const play = player(state, () => [state.plan.start, state.plan.end], setTime, (on) => (byId("play").textContent = on ? "Pause" : "Play"));
const halt = () => play(false);

function setTime(t) {
  state.time = t;
  byId("scrub").value = (t - state.plan.start) / (state.plan.end - state.plan.start);
  byId("clock").textContent = `${t.toFixed(2)} of ${state.plan.end.toFixed(2)} s`;
  paint();
}

// --- the margin of the straight line, now and as it was before the change

const margin = { x: "duration, s", y: "margin, % of the weight", height: 190, series: [{ name: "now", colour: "var(--robust)", x: [0, 1], y: [0, 0] }], lines: [{ y: 0, label: "it slides, tips or spills below", below: true }], range: [-20, 60] };
const drawChart = chart(byId("margin"), margin);

function drawMargin(line) {
  byId("line").textContent = line ? line.sentence : "";
  const curve = (name, { t, margin: y }, more) => ({ name, colour: "var(--robust)", x: t, y, ...more });
  margin.series = [];
  if (state.before && line) margin.series.push(curve("before", state.before, { colour: "var(--faint)", dash: "4 3", width: 1.2 }));
  if (line) margin.series.push(curve("now", line));
  if (line) margin.range[1] = 10 * Math.ceil(0.11 * Math.max(20, ...margin.series.flatMap((s) => s.y)));
  drawChart();
}

// --- what is set by sliders

function choose(name) {
  state.chosen = name;
  list();
  paint();
}

function list() {
  const parts = state.answer.parts, names = parts.map((part) => part.name), chosen = byId("chosen");
  if (!names.includes(state.chosen)) state.chosen = "start";
  const part = parts[names.indexOf(state.chosen)], shape = JSON.stringify([names, state.chosen, part.fields.map((f) => f.label)]);
  byId("remove").disabled = !part.removable;
  if (shape === list.shown) return part.fields.forEach((field, i) => list.set[i](field));
  list.shown = shape;
  chosen.replaceChildren(...names.map((name) => new Option(name, name)));
  chosen.value = state.chosen;
  list.set = [];
  byId("fields").replaceChildren(...(part.lists ?? []).flatMap(choices), ...part.fields.flatMap(slider));
}

function choices({ label, key, choices: several, value }) {
  const name = document.createElement("span"), select = document.createElement("select");
  name.textContent = label;
  select.setAttribute("aria-label", label);
  select.append(...several.map((one) => new Option(one, one)));
  select.value = value;
  select.addEventListener("change", () => edit({}, { changes: [[key, select.value]] }));
  return [name, select];
}

function slider(field) {
  const name = document.createElement("span"), range = document.createElement("input"), exact = document.createElement("input"), unit = document.createElement("small");
  let now = field, gesture = null;
  [range.type, exact.type, exact.step, name.textContent, unit.textContent] = ["range", "number", "any", field.label, field.unit];
  for (const input of [range, exact]) input.setAttribute("aria-label", field.label);
  const put = (fresh) => {
    now = fresh;
    range.min = fresh.low;
    range.max = fresh.high;
    range.step = 10 ** Math.round(Math.log10((fresh.high - fresh.low) / 300));
    if (document.activeElement !== range || gesture === null) range.value = fresh.value;
    if (document.activeElement !== exact) exact.value = Number(fresh.value.toPrecision(6));
  };
  const set = (text) => {
    const x = Number(text);
    if (text === "" || !Number.isFinite(x)) return;
    let value = now.percent ? `${x}%` : x;
    if (now.zero && x === 0) value = null;
    if (now.whole) value = now.whole.map((y, i) => (i === now.each ? x : y));
    edit((gesture ??= {}), { changes: [[now.key, value]] });
  };
  range.addEventListener("input", () => ((exact.value = range.value), set(range.value)));
  exact.addEventListener("input", () => set(exact.value));
  for (const input of [range, exact]) input.addEventListener("change", () => ((gesture = null), put(now)));
  list.set.push(put);
  put(field);
  return [name, range, exact, unit];
}

// The place on the tray that is furthest from those that are taken.
function freest(taken) {
  const [x, y] = state.answer.scene.tray.size, steps = [0, 0.3, -0.3, 0.15, -0.15];
  const away = (p) => Math.min(...taken.map((q) => Math.hypot(p[0] - q[0], p[1] - q[1])));
  const places = steps.flatMap((a) => steps.map((b) => [a * x, b * y]));
  return places.reduce((best, p) => (away(p) > away(best) + 1e-9 ? p : best)).map((v) => Number(v.toFixed(3)));
}

const additions = [
  ...Object.entries(given.loads).map(([name, load]) => [name, "objects", load]),
  ...Object.entries(given.obstacles).map(([name, obstacle]) => [`obstacle: ${name}`, "obstacles", obstacle]),
];
// A side view of a load or an obstacle, all to one scale; what is liquid is blue.
function pictured(thing) {
  const { size, radius, height, type } = thing.shape ?? thing, image = svg("svg", { viewBox: "-12 -26 24 26", width: 24, height: 26 });
  const [w, h] = [100 * (size?.[0] ?? 2 * radius), 100 * (size?.[2] ?? height ?? 2 * radius)];
  svg("rect", { x: -w / 2, y: -h, width: w, height: h, rx: type === "sphere" ? w / 2 : 0.6, fill: thing.shape ? "#e69f00" : "#8a919b" }, image);
  if (thing.liquid) svg("rect", { x: -100 * thing.liquid.radius, y: -100 * thing.liquid.fill, width: 200 * thing.liquid.radius, height: 100 * thing.liquid.fill, fill: "#0072b2" }, image);
  return image;
}
byId("add").append(...additions.map(([name, , thing], i) => {
  const entry = new Option("", i);
  entry.append(pictured(thing), name);
  return entry;
}));
byId("add").addEventListener("change", (event) => {
  const [name, key, value] = additions[Number(event.target.value)], there = state.answer.parts.filter((part) => part.key[0] === key);
  event.target.value = "";
  const names = new Set(state.answer.parts.map((part) => part.name));
  let called = name.split(" ")[name.startsWith("obstacle") ? 1 : 0], k = 2;
  while (names.has(called)) called = called.replace(/\d*$/, "") + k++;
  const place = key === "objects" ? { at: freest(there.map((part) => part.at)) } : {};
  edit({}, { changes: [[[key, there.length], { name: called, ...value, ...place }]] });
  state.chosen = called;
});
byId("remove").addEventListener("click", () => {
  const part = state.answer.parts.find(({ name }) => name === state.chosen);
  edit({}, { changes: [[part.key, null]] });
});
byId("chosen").addEventListener("change", (event) => choose(event.target.value));
byId("leg").addEventListener("change", (event) => {
  state.leg = Number(event.target.value);
  edit({}, { text: state.text, back: true, kept: state.plan });
});

// --- buttons and text

function back(from, to) {
  while (from.length && from[from.length - 1] === state.text) from.pop();  // of a drag that came back
  if (!from.length || asking) return;
  to.push(state.text);
  edit({}, { text: from.pop(), back: true });
}

async function save() {
  const text = state.text, answer = await post("save", { text, over: state.saved });
  if (answer.saved) state.saved = text;
  state.said = answer.problem ?? `Saved in ${answer.saved}.`;
  tell();
}

let pause = null;
byId("text").value = state.text;
byId("text").addEventListener("input", () => {
  state.typing ??= {};
  clearTimeout(pause);
  pause = setTimeout(() => (state.typing = null), 1000);  // ms, after which undo takes a new step
  edit(state.typing, { text: byId("text").value, typed: true });
});
byId("text").addEventListener("scroll", scrolled);
byId("plan").addEventListener("click", plan);
byId("follow").addEventListener("change", (event) => event.target.checked && !state.plan && plan());
byId("beside").addEventListener("change", paint);
for (const button of document.querySelectorAll(".more")) button.addEventListener("click", more);
byId("export").append(...Object.keys(given.formats).map((name) => new Option(name, name)));
byId("export").addEventListener("change", async (event) => {
  const kind = event.target.value, file = await (await fetch(`${here}${kind}/${own}`)).blob();
  event.target.value = "";
  state.said = file.type.startsWith("text/plain") ? await file.text() : "";
  tell();
  const ending = given.formats[kind] + (file.type === "application/zip" ? ".zip" : "");
  if (!state.said) Object.assign(document.createElement("a"), { href: URL.createObjectURL(file), download: `motion${ending}` }).click();
});
byId("play").addEventListener("click", () => play(!state.playing));
byId("scrub").addEventListener("input", (event) => {
  halt();
  setTime(state.plan.start + Number(event.target.value) * (state.plan.end - state.plan.start));
});
byId("undo").addEventListener("click", () => back(state.done, state.undone));
byId("redo").addEventListener("click", () => back(state.undone, state.done));
byId("save").addEventListener("click", save);
byId("copy").addEventListener("click", async () => {
  await navigator.clipboard?.writeText(given.command).catch(() => null);
  state.said = `${given.command}${state.text === state.saved ? "" : " (save first)"}`;
  tell();
});
document.addEventListener("keydown", (event) => {
  if (state.live) return;
  const key = (event.ctrlKey || event.metaKey) && event.key.toLowerCase();
  const does = { z: () => (event.shiftKey ? back(state.undone, state.done) : back(state.done, state.undone)), y: () => back(state.undone, state.done), s: save }[key];
  if (!does) return;
  event.preventDefault();
  does();
});
window.addEventListener("pagehide", () => navigator.sendBeacon(here + "say", JSON.stringify({ do: "close", window: own })));
window.addEventListener("beforeunload", (event) => state.done.length && state.text !== state.saved && event.preventDefault());
state.saved = given.saved ? given.text : null;
byId("remove").disabled = true;
number();
edit({}, { text: state.text });
state.idle = () => !asking && !queue.length;
window.salver = { state, placeOf, handles, halt, setTime };
