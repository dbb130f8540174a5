// The page of the playground: frames come as server-sent events, wishes go as small messages.
"use strict";

const scene = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const here = location.pathname.replace(/\/?$/, "/");
const SECONDS = 10;  // of the strips
const RING = 0.045, NEAR = 34;  // m; pixels from the goal within which it is taken hold of
const state = { frame: scene.first, frames: 0, goal: null, keys: new Set(), viewer: null, answer: "", sent: 0 };

function say(message) {
  state.sent += 1;
  return fetch(here + "say", { method: "POST", body: JSON.stringify(message) })
    .then((response) => response.json())
    .then((answer) => {
      state.answer = answer.ok ? "" : answer.sentence;
      return answer;
    })
    .catch(() => (state.answer = "salver does not answer."));
}

// --- what is seen

let painted = -1, turned = true;  // the frame that was drawn last, and whether the camera moved since

const viewer = state.viewer = createViewer(byId("canvas"), scene);
const identity = Mat.pose([0, 0, 0, 1, 0, 0, 0]);
const at = (p) => Mat.pose([...p, 1, 0, 0, 0]);
const marks = {};

function buildMarks() {
  const ring = [], sides = 40;
  for (let i = 0; i <= sides; i++) ring.push([RING * Math.cos((2 * Math.PI * i) / sides), RING * Math.sin((2 * Math.PI * i) / sides), 0]);
  marks.ring = { shape: viewer.upload(tube(ring, 0.004)), model: identity, colour: [0.84, 0.37, 0.0, 1], flat: true };
  marks.drop = { shape: viewer.upload(revolve([[0.0015, -1], [0.0015, 0]], 8)), model: identity, colour: [0.84, 0.37, 0.0, 0.5], flat: true };
  marks.ball = { shape: viewer.upload(sphere(1)), model: identity, colour: [0.80, 0.15, 0.25, 1] };
}

// Where the ring is: at the goal; without one around the load, where it is taken hold of.
const ring = () => state.goal || state.frame.goal || state.frame.objects[0].slice(0, 3);

function sphere(radius, rings = 12) {
  const profile = [];
  for (let i = 0; i <= rings; i++) profile.push([radius * Math.sin((Math.PI * i) / rings), -radius * Math.cos((Math.PI * i) / rings)]);
  return revolve(profile, 20);
}

function paint() {
  if (!viewer) return;
  const frame = state.frame, live = viewer.variants[0];
  live.joints = new Float32Array(frame.joints);
  live.tray = new Float32Array(frame.tray);
  live.objects = new Float32Array(frame.objects.flat());
  frame.inside.forEach((seen, i) => {
    if (seen) Object.assign(live.inside[i], { moves: new Float32Array(seen.moves), beyond: seen.beyond === null ? null : 0 });
  });
  viewer.options.path = frame.path.length > 1;
  if (viewer.options.path) viewer.refill(live.path, tube(frame.path, 0.0025));
  const goal = ring();
  marks.ring.model = at(goal);
  marks.drop.model = Mat.pose([...goal, 1, 0, 0, 0], 0, [1, 1, Math.max(goal[2] - scene.floor, 1e-3)]);
  viewer.marks.splice(0, viewer.marks.length, marks.ring, marks.drop);
  for (const ball of frame.balls || []) {
    marks.ball.model = Mat.pose([...ball.p, 1, 0, 0, 0], 0, [ball.r, ball.r, ball.r]);
    viewer.marks.push({ ...marks.ball });
  }
  viewer.render(0);
}

const WORDS = { resting: "The arm rests", following: "Following", stopping: "Stopping", unprotected: "Without protection" };
const BECAME = { lost: "is off the tray", fallen: "has fallen over", slid: "has slid", spilt: "has spilt" };

const TRY = "Drag the ring, or hold W A S D: the arm follows and its load stays. Try to make it slide, fall or spill; then uncheck “protected” and try again.";
const UNPROTECTED = "The same hand moves the arm, and nothing keeps the load on its tray. Check “protected” again when it rests, or begin again.";

function tell() {
  const frame = state.frame, gone = frame.load.filter((item) => item.became);
  const bad = gone.length > 0, planning = frame.doing === "resting" && frame.protected && (frame.planning || dragged !== null);
  byId("verdict").className = `verdict ${bad ? "bad" : frame.protected ? "" : "warning"}`;
  byId("doing").textContent = bad
    ? `The ${gone.map((item) => `${item.name} ${BECAME[item.became]}`).join(", the ")}.`
    : frame.doing === "following" || frame.doing === "stopping"
      ? `${WORDS[frame.doing]}: at rest in ${frame.restsIn.toFixed(2)} s, ${frame.nearest}.`
      : planning
        ? "Planning a safe way to the ring."
        : `${WORDS[frame.doing]}.`;
  byId("detail").textContent = [state.answer, frame.said].filter(Boolean).join(" ") || (frame.doing === "resting" && !planning ? TRY : frame.doing === "unprotected" && !bad ? UNPROTECTED : "");
  byId("protected").checked = frame.protected;
  byId("stop").firstChild.textContent = frame.stopped ? "Resume " : "Stop ";
  byId("limit").textContent = frame.protected ? `${(100 * frame.margin).toFixed(1)} % at ${frame.limit}` : "nothing is committed";
  byId("friction-shown").textContent = frame.load.map((item, i) => `${item.name} ${frame.friction[i].toFixed(2)}`).join(" · ");
  byId("speed-now").textContent = `${frame.speed.toFixed(2)} m/s`;
  const slow = frame.pace < 0.97 ? ` This machine runs it at ${Math.round(100 * frame.pace)} % of real time.` : "";
  byId("pace").textContent = `Planning takes up to ${Math.round(1000 * frame.lead)} ms.${slow}${frame.planner ? "" : " The planner is dead."}`;
  const recording = frame.recording !== null;
  byId("record").setAttribute("aria-pressed", recording);
  byId("record").textContent = recording ? `Recording, ${frame.recording.toFixed(0)} s` : "Record";
}

// Values of the last seconds, the newest on the right.
function strip(id, value, low, high, line) {
  const canvas = byId(id), ratio = Math.min(window.devicePixelRatio || 1, 2), points = [];
  return () => {
    const frame = state.frame, [width, height] = [canvas.clientWidth, canvas.clientHeight];
    points.push([frame.t, value(frame)]);
    while (points.length && points[0][0] < frame.t - SECONDS) points.shift();
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const pen = canvas.getContext("2d"), style = getComputedStyle(document.body);
    pen.scale(ratio, ratio);
    const X = (t) => width - ((frame.t - t) / SECONDS) * width, Y = (y) => height - 6 - ((Math.min(Math.max(y, low), high) - low) / (high - low)) * (height - 12);
    pen.strokeStyle = style.getPropertyValue("--grid");
    pen.fillStyle = style.getPropertyValue("--tick");
    pen.font = "10px system-ui, sans-serif";
    for (const y of ticks(low, high, 3)) {
      pen.beginPath();
      pen.moveTo(0, Y(y));
      pen.lineTo(width, Y(y));
      pen.stroke();
      pen.fillText(y.toString(), 4, Y(y) - 2);
    }
    if (line !== null) {
      pen.strokeStyle = style.getPropertyValue("--bad");
      pen.beginPath();
      pen.moveTo(0, Y(line));
      pen.lineTo(width, Y(line));
      pen.stroke();
    }
    pen.strokeStyle = style.getPropertyValue("--robust");
    pen.lineWidth = 1.6;
    pen.beginPath();
    let drawing = false;
    for (const [t, y] of points) {
      if (y === null) drawing = false;
      else {
        drawing ? pen.lineTo(X(t), Y(y)) : pen.moveTo(X(t), Y(y));
        drawing = true;
      }
    }
    pen.stroke();
  };
}

const strips = [
  strip("margin", (frame) => (frame.protected ? frame.margin : null), 0, 0.5, 0),
  strip("friction", (frame) => Math.max(...frame.friction), 0, 1.2, 1),
  strip("velocity", (frame) => frame.speed, 0, 2, null),
];

// --- the hand

function held() {
  const k = state.keys, speed = Number(byId("speed").value), a = viewer ? viewer.orbit.azimuth : 0;
  const along = Number(k.has("w")) - Number(k.has("s")), across = Number(k.has("d")) - Number(k.has("a")), up = Number(k.has("r")) - Number(k.has("f"));
  const size = Math.hypot(along, across, up) || 1, turn = Number(k.has("q")) - Number(k.has("e"));
  // Away from who looks, and to the right.
  const x = -along * Math.cos(a) - across * Math.sin(a), y = -along * Math.sin(a) + across * Math.cos(a);
  return [x, y, up].map((v) => (v / size) * speed).concat(1.5 * turn);
}

const STEERING = new Set("wasdrfqe");
let steering = null;
function steer() {
  if (state.keys.size) {
    state.goal = null;
    say({ twist: held() });
    steering ??= setInterval(steer, 40);
  } else if (steering !== null) {
    clearInterval(steering);
    steering = null;
    say({ twist: [0, 0, 0, 0] });
  }
}

document.addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (key === " ") {
    event.preventDefault();
    if (!event.repeat) stop();
  } else if (STEERING.has(key)) {
    event.preventDefault();
    if (event.repeat || state.keys.has(key)) return;
    state.keys.add(key);
    steer();
  }
});
document.addEventListener("keyup", (event) => {
  if (state.keys.delete(event.key.toLowerCase()) && !state.keys.size) steer();
});
window.addEventListener("blur", () => {
  state.keys.clear();
  steer();
});

function stop() {
  state.goal = null;
  state.keys.clear();
  if (steering !== null) clearInterval(steering);
  steering = null;
  return say({ stop: true });
}

byId("stop").addEventListener("click", () => (state.frame && state.frame.stopped ? say({ resume: true }) : stop()));
byId("again").addEventListener("click", () => {
  state.goal = null;
  say({ again: true });
});
byId("throw").addEventListener("click", () => say({ throw: true }));
byId("record").addEventListener("click", () => say({ record: state.frame.recording === null }));
byId("protected").addEventListener("change", (event) => say({ protected: event.target.checked }));
byId("speed").addEventListener("input", () => (byId("speed-shown").textContent = `${Number(byId("speed").value).toFixed(2)} m/s`));
byId("speed").dispatchEvent(new Event("input"));

// The goal, where a pointer is near enough to take hold of it.
function nearGoal(event) {
  const [metres, pixels] = viewer.missed(event, ring());
  return metres < RING || pixels < NEAR ? ring() : null;
}

let dragged = null, said = 0;
function drag(event) {
  const p = viewer.onPlane(event, dragged, event.shiftKey);
  if (!p) return;
  dragged = event.shiftKey ? [dragged[0], dragged[1], p[2]] : [p[0], p[1], dragged[2]];
  dragged[2] = Math.max(scene.floor + 0.02, dragged[2]);
  state.goal = dragged;
  turned = true;  // the ring is drawn at once, not with the next frame
  if (performance.now() - said < 80) return;
  said = performance.now();
  say({ goto: dragged });
}

if (viewer) {
  buildMarks();
  const canvas = byId("canvas");
  canvas.addEventListener("pointerdown", (event) => {
    dragged = nearGoal(event);
    if (!dragged) return;
    event.stopImmediatePropagation();  // not the camera's
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (dragged) drag(event);
  });
  canvas.addEventListener("pointerup", () => {
    if (dragged && state.goal) say({ goto: state.goal });
    dragged = null;
  });
  attachOrbit(canvas, viewer, () => (turned = true));
  new ResizeObserver(() => (turned = true)).observe(canvas);
  const darkness = window.matchMedia("screen and (prefers-color-scheme: dark)");
  const dark = () => (viewer.options.dark = darkness.matches);
  dark();
  darkness.addEventListener("change", dark);
} else byId("canvas").replaceWith("This browser has no WebGL 2, so nothing can be drawn; the hand works.");

const source = new EventSource(here + "frames");
source.onmessage = (event) => {
  state.frame = JSON.parse(event.data);
  state.frames += 1;
  if (!dragged && state.frame.goal === null && !state.keys.size) state.goal = null;
};
source.onerror = () => (state.answer = "salver does not answer.");
// Drawn when there is something new: a browser that draws all the time takes the processor away from the planner.
function each() {
  if (state.frames !== painted || turned) {
    if (state.frames !== painted) for (const draw of strips) draw();
    [painted, turned] = [state.frames, false];
    paint();
    tell();
  }
  requestAnimationFrame(each);
}
each();
window.salver = { state, say, viewer, stop };
