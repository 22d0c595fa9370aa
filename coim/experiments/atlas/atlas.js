"use strict";
// The page: choices, sliders, and the robot that walks.

const page = JSON.parse(document.getElementById("data").textContent);
const find = (name) => document.getElementById(name);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const LONGEST_LAG = 0.1; // s of the clock that are caught up with, so that a hidden page does not race afterwards
const EDGE = { outer: 1.5, name: "text" }, INSIDE = { outer: 0, name: "robot" }; // a capsule is painted twice; `outer` in pixels

const shown = { run: page.runs[0], body: null, mujoco: null, walker: null, playing: true, last: null, due: 0, failure: "" };
const sliders = page.body.names.map((name, i) => {
  const slider = Object.assign(document.createElement("input"), {
    type: "range", id: `slider-${i}`, min: page.body.low[i], max: page.body.high[i], step: "any",
  });
  const value = Object.assign(document.createElement("output"), { htmlFor: slider.id });
  const label = Object.assign(document.createElement("label"), { htmlFor: slider.id, textContent: name });
  find("sliders").append(label, slider, value);
  slider.addEventListener("input", changed);
  return { slider, value };
});
const design = () => sliders.map(({ slider }) => Number(slider.value));

function setSliders(values) {
  sliders.forEach(({ slider }, i) => (slider.value = values[i]));
  tellSliders();
}

function tellSliders() {
  for (const { slider, value } of sliders) value.textContent = Number(slider.value).toFixed(2);
}

// Of the bodies whose walk was recorded, the one that is nearest to the sliders.
function nearest(values) {
  const apart = ({ design }) => design.reduce((sum, value, i) => sum + ((value - values[i]) / (page.body.high[i] - page.body.low[i])) ** 2, 0);
  const walked = shown.run.bodies.filter(({ number }) => shown.run.walks[number]);
  return walked.reduce((best, body) => (best === null || apart(body) < apart(best) ? body : best), null);
}

function simulates() {
  return shown.mujoco !== null && Object.keys(shown.run.policies).length > 0;
}

// The sliders were moved.
function changed() {
  tellSliders();
  tellBody(null);
  if (simulates() && shown.walker instanceof Simulation) shown.walker.build(design());
  else begin();
}

function choose(body) {
  setSliders(body.design);
  tellBody(body);
  begin();
}

function begin() {
  const walker = shown.walker;
  if (walker instanceof Simulation) {
    walker.model.delete();
    walker.data.delete();
  }
  shown.walker = null;
  if (simulates()) {
    const policy = new Policy(shown.run.policies[find("policy").value]);
    shown.walker = new Simulation(shown.mujoco, page.body, policy, design());
  } else {
    const body = nearest(design());
    if (body !== null) {
      shown.walker = new Recording(shown.run.walks[body.number], body.outline, page.frame_seconds);
      setSliders(body.design);
      tellBody(body);
    }
  }
  shown.last = null;
  draw();
}

function tellBody(body) {
  shown.body = body;
  find("body").textContent = body === null ? "A body that the run has not tried." : `${inWords(body)}.`;
  for (const button of find("bodies").children) button.setAttribute("aria-pressed", String(button.dataset.number === String(body?.number)));
}

function chooseRun(run) {
  shown.run = run;
  const names = Object.keys(run.policies);
  find("policy").replaceChildren(...names.map((name) => new Option(name, name)));
  if (names.length) find("policy").value = names.at(-1);
  find("policies").hidden = !(names.length && shown.mujoco !== null);
  const extents = run.bodies.map(({ outline }) => extent(seen(outline, page.body.axes)));
  const tallest = Math.max(...extents.map(([low, high]) => high - low));
  run.extent = [Math.min(...extents.map(([low]) => low)), Math.max(...extents.map(([, high]) => high))];
  find("bodies").replaceChildren(...run.bodies.map((body) => {
    const button = Object.assign(document.createElement("button"), { type: "button", title: inWords(body) });
    button.dataset.number = body.number;
    button.append(drawOutline(body, page.body.axes, 88 / tallest, tallest), `${body.number}`, document.createElement("br"), `${Math.round(body.best)}`);
    button.addEventListener("click", () => choose(body));
    return button;
  }));
  find("notes").replaceChildren(...run.notes.map((note) => Object.assign(document.createElement("p"), { textContent: note })));
  drawCharts();
  choose(run.bodies[run.best]);
}

function drawCharts() {
  drawReturns(find("returns"), shown.run, choose);
  drawGains(find("gains"), shown.run, page.body.names);
  if (page.runs.length > 1) drawBest(find("best"), page.runs, page.body, shown.run);
}

// The robot, followed on its way: from the side above a floor with a mark at each metre, or on a floor of squares of 1 m.
function draw() {
  const canvas = find("stage"), ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio)) Object.assign(canvas, { width: width * ratio, height: height * ratio });
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  if (shown.walker === null) return;
  const capsules = shown.walker.capsules(), [x1, y1, , x2, y2] = capsules[0];
  const place = [(x1 + x2) / 2, (y1 + y2) / 2];
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "center";
  context.lineCap = "round";
  const { axes } = page.body, flat = axes[2][2] === 0;
  (flat ? drawFromTheSide : drawFromAbove)(context, { width, height, capsules: seen(capsules, axes), place, axes });
  const time = shown.walker.steps * shown.walker.seconds;
  find("place").textContent = `${place[0].toFixed(1)} m in ${time.toFixed(1)} s`;
}

function drawFromTheSide(context, { width, height, capsules, place }) {
  const tall = 1.15 * Math.max(1, shown.run.extent[1]);
  const metre = (height - 40) / tall, floor = height - 28, [middle] = place;
  const across = (x) => width / 2 + (x - middle) * metre;
  context.fillStyle = colour("faint");
  context.fillRect(0, floor, width, height - floor);
  context.fillStyle = colour("soft");
  const reach = width / 2 / metre;
  for (let x = Math.ceil(middle - reach); x <= middle + reach; x++) {
    context.fillRect(across(x), floor, 1, 6);
    context.fillText(`${x} m`, across(x), height - 6);
  }
  const down = (z) => floor - z * metre;
  for (const paint of [EDGE, INSIDE]) for (const capsule of capsules) drawCapsule(context, capsule, across, down, metre, paint);
}

function drawFromAbove(context, { width, height, capsules, place, axes }) {
  const [low, high] = shown.run.extent, metre = height / Math.max(1.5, 2.2 * (high - low));
  const onFloor = (x, y) => [0, 1].map((axis) => axes[axis][0] * x + axes[axis][1] * y);
  const [right, up] = onFloor(...place), level = height / 2 + ((low + high) / 2) * metre;
  const across = (u) => width / 2 + (u - right) * metre, down = (v) => level - (v - up) * metre;
  const reach = Math.ceil((2 * Math.hypot(width, height)) / metre), [x0, y0] = place.map(Math.round);
  const line = (from, to) => {
    context.moveTo(across(from[0]), down(from[1]));
    context.lineTo(across(to[0]), down(to[1]));
  };
  context.strokeStyle = colour("faint");
  context.lineWidth = 1.5;
  context.beginPath();
  for (let k = -reach; k <= reach; k++) {
    line(onFloor(x0 + k, y0 - reach), onFloor(x0 + k, y0 + reach));
    line(onFloor(x0 - reach, y0 + k), onFloor(x0 + reach, y0 + k));
  }
  context.stroke();
  context.fillStyle = colour("soft");
  const lane = y0 - 1; // a line of squares before the robot
  for (let x = x0 - reach; x <= x0 + reach; x++) {
    const [u, v] = onFloor(x, lane);
    context.fillText(`${x} m`, across(u), down(v) + 4);
  }
  // The farthest first, each with an edge of its own: so one sees which leg is before the other.
  for (const capsule of capsules) for (const paint of [EDGE, INSIDE]) drawCapsule(context, capsule, across, down, metre, paint);
}

function drawCapsule(context, [u1, v1, u2, v2, radius], across, down, metre, { outer, name }) {
  context.strokeStyle = colour(name);
  context.lineWidth = 2 * (radius * metre + outer);
  context.beginPath();
  context.moveTo(across(u1), down(v1));
  context.lineTo(across(u2) + (u1 === u2 && v1 === v2 ? 0.01 : 0), down(v2));
  context.stroke();
}

function tick(now) {
  const walker = shown.walker;
  if (shown.playing && walker !== null) {
    const passed = shown.last === null ? 0 : (now - shown.last) / 1000;
    shown.due = Math.min(shown.due + passed, LONGEST_LAG);
    for (; shown.due >= walker.seconds; shown.due -= walker.seconds) walker.step();
    draw();
  }
  shown.last = now;
  requestAnimationFrame(tick);
}

find("reset").addEventListener("click", () => {
  shown.walker?.reset();
  draw();
});
find("pause").addEventListener("click", () => {
  shown.playing = !shown.playing;
  find("pause").textContent = shown.playing ? "Pause" : "Go on";
});
find("policy").addEventListener("change", begin);
find("run")?.addEventListener("change", ({ target }) => chooseRun(page.runs[target.value]));
new ResizeObserver(() => {
  drawCharts();
  draw();
}).observe(document.body);

async function start() {
  const [module, binary] = ["mujoco-module", "mujoco-binary"].map((name) => find(name)?.textContent);
  chooseRun(page.runs[0]);
  requestAnimationFrame(tick);
  if (module === undefined) return;
  find("how").textContent = "Starting the simulator ...";
  try {
    shown.mujoco = await loadMujoco(module, binary);
    find("how").textContent = find("how").dataset.simulated;
  } catch (error) {
    find("how").textContent = `This browser cannot start the simulator (${error.message}). ${find("how").dataset.recorded}`;
  }
  chooseRun(shown.run);
}

start();
