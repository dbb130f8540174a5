// The page: charts into their places, replay controls, one time for everything.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const state = { time: 0, playing: false, speed: 1, viewer: null };

function setTime(t) {
  state.time = Math.max(data.replay.start, Math.min(data.replay.duration, t));
  chart.time = state.time;
  setCursor(state.time);
  byId("scrub").value = state.time;
  byId("clock").textContent = `${state.time.toFixed(2).replace("-", "−")} s of ${data.replay.duration.toFixed(2)} s`;
  paint();
}

function paint() {
  if (!state.viewer) return;
  const { stacked, shown: shownKeys } = state.viewer.render(state.time);
  const names = byId("names"), text = shownKeys.map((keys) => keys.join()).join("|");
  names.classList.toggle("stacked", stacked);
  if (names.dataset.shown === text) return;
  names.dataset.shown = text;
  names.replaceChildren(...shownKeys.map((keys) => {
    const box = document.createElement("div");
    for (const key of keys) {
      const variant = data.replay.variants.find((v) => v.key === key), title = document.createElement("b");
      title.textContent = variant.label + (keys.length > 1 && key !== keys[0] ? " (ghost)" : "");
      title.className = "series";
      title.style.color = `rgb(${variant.colour.map((c) => Math.round(255 * c)).join()})`;
      box.append(title, ...[variant.about, variant.caption].filter(Boolean).map((text) => {
        const line = document.createElement("div");
        line.textContent = text;
        return line;
      }));
    }
    return box;
  }));
}

const setPlaying = player(state, () => [data.replay.start, data.replay.duration], setTime, (on) => {
  byId("play").textContent = on ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", on);
});

// A strip above the scrubber: how near each motion is to its limit, so that the eye finds the critical moments.
function drawTimeline() {
  const image = byId("strip");
  image.setAttribute("viewBox", "0 0 1000 34");
  image.setAttribute("preserveAspectRatio", "none");
  for (const strip of data.replay.strips) {
    const X = (t) => (1000 * (t - data.replay.start)) / (data.replay.duration - data.replay.start), Y = (v) => 33 - 30 * v;
    const line = strip.x.map((t, i) => `${i ? "L" : "M"}${X(t).toFixed(1)} ${Y(strip.y[i]).toFixed(1)}`).join("");
    svg("path", { d: `${line}L${X(strip.x[strip.x.length - 1])} 34L${X(strip.x[0])} 34Z`, fill: strip.colour, opacity: 0.16 }, image);
  }
}

// When the plan has the most friction in use: the moment that is on paper.
function nearestToLimit() {
  const { x, y } = data.replay.strips[0];
  return x[y.indexOf(Math.max(...y))];
}

function buildCharts() {
  for (const host of document.querySelectorAll("[data-chart]")) {
    const spec = data.charts[host.dataset.chart];
    legend(host.previousElementSibling, spec);
    chart(host, spec, (t) => {
      setPlaying(false);
      setTime(t);
    });
  }
}

function buildReplay() {
  const canvas = byId("canvas");
  let viewer = null;
  try {
    viewer = createViewer(canvas, data.replay);
  } catch (error) {
    viewer = null;
  }
  if (!viewer) {
    const text = document.createElement("p");
    text.className = "none";
    text.textContent = "This browser has no WebGL 2, so the 3-D replay cannot be shown; all else on the page works.";
    canvas.replaceWith(text);
  } else {
    state.viewer = viewer;
    attachView(canvas, viewer, paint);
    for (const name of ["forces", "cones", "path"])
      byId(name).addEventListener("change", (event) => {
        viewer.options[name] = event.target.checked;
        paint();
      });
    for (const name of ["layout", "camera"])
      byId(name).addEventListener("change", (event) => {
        viewer.options[name] = event.target.value;
        if (name === "camera") viewer.reset();
        paint();
      });
  }
  if (data.replay.objects.length > 1)
    for (const name of ["forces", "cones"]) byId(name).parentNode.append(` of ${data.replay.contacts.owner}`);
  byId("scrub").min = data.replay.start;
  byId("scrub").max = data.replay.duration;
  byId("scrub").addEventListener("input", (event) => {
    setPlaying(false);
    setTime(Number(event.target.value));
  });
  byId("speed").addEventListener("change", (event) => (state.speed = Number(event.target.value)));
  byId("play").addEventListener("click", () => setPlaying(!state.playing));
  document.addEventListener("keydown", (event) => {
    if (/INPUT|SELECT|BUTTON|SUMMARY/.test(event.target.tagName) && event.target.id !== "scrub") return;
    if (event.key === " ") {
      event.preventDefault();
      setPlaying(!state.playing);
    } else if (event.key === "ArrowRight" || event.key === "ArrowLeft") {
      if (event.target.id === "scrub") return;
      setPlaying(false);
      setTime(state.time + (event.key === "ArrowRight" ? 0.02 : -0.02));
    }
  });
  drawTimeline();
}

buildReplay();
buildCharts();
setTime(0);
if (state.viewer && !window.matchMedia("(prefers-reduced-motion: reduce)").matches) setPlaying(true);
window.addEventListener("beforeprint", () => {
  redrawAll(true);
  setPlaying(false);
  setTime(nearestToLimit());
});
window.addEventListener("afterprint", () => redrawAll(false));
window.salver = { state, data, setTime, setPlaying };
