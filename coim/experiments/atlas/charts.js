"use strict";
// Drawings in SVG, in CSS pixels of the screen: text keeps its size on a phone.

const SVG = "http://www.w3.org/2000/svg";

function make(name, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function titled(element, words) {
  element.prepend(make("title", {}, words));
  return element;
}

// Round numbers from low to high, about `count` of them.
function ticks(low, high, count) {
  const rough = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((factor) => factor >= rough);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, i) => +((first + i) * step).toPrecision(12));
}

// An empty chart of the width of its place, with horizontal lines or vertical ones, and functions from values to pixels.
function chart(place, { height, x, y = null, left = 52, label = "", below = "" }) {
  const width = Math.max(place.clientWidth, 240), right = 12, top = 22, bottom = 38;
  const scale = ([low, high], from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);
  const across = scale(x, left, width - right), up = y && scale(y, height - bottom, top);
  const svg = make("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img" });
  for (const value of y ? ticks(...y, 5) : []) {
    svg.append(make("line", { x1: left, x2: width - right, y1: up(value), y2: up(value), class: "grid" }));
    svg.append(make("text", { x: left - 6, y: up(value) + 4, "text-anchor": "end" }, String(value)));
  }
  for (const value of ticks(...x, Math.max(2, Math.floor(width / 90)))) {
    if (!y) svg.append(make("line", { x1: across(value), x2: across(value), y1: top, y2: height - bottom, class: "grid" }));
    svg.append(make("text", { x: across(value), y: height - bottom + 16, "text-anchor": "middle" }, String(value)));
  }
  svg.append(make("text", { x: y ? 4 : left, y: 13 }, label));
  svg.append(make("text", { x: width - right, y: height - 6, "text-anchor": "end" }, below));
  place.replaceChildren(svg);
  return { svg, across, up, width, top, bottom: height - bottom };
}

const MARKS = {
  first: (x, y) => make("circle", { cx: x, cy: y, r: 5 }),
  optimised: (x, y) => make("path", { d: `M${x - 6} ${y + 5}L${x} ${y - 6}L${x + 6} ${y + 5}Z` }),
  random: (x, y) => make("rect", { x: x - 4.5, y: y - 4.5, width: 9, height: 9 }),
  fixed: (x, y) => make("path", { d: `M${x - 6} ${y}L${x} ${y - 6}L${x + 6} ${y}L${x} ${y + 6}Z` }),
};

function mark(kind, x, y) {
  const element = MARKS[kind](x, y);
  element.setAttribute("class", `kind-${kind}`);
  return element;
}

// Best return of each body over the order of building, and the interval that was expected of it.
function drawReturns(place, run, choose) {
  const bodies = run.bodies, known = (value) => value !== null;
  const all = bodies.flatMap(({ best, low, high }) => [best, low, high]).filter(known);
  const edge = 0.05 * (Math.max(...all) - Math.min(...all) || 1);
  const drawn = chart(place, {
    height: 260,
    x: [0, bodies.at(-1).number + 1],
    y: [Math.min(0, ...all), Math.max(...all) + edge],
    label: "best return",
    below: "body, in the order of building",
  });
  for (const body of bodies) {
    const x = drawn.across(body.number);
    if (known(body.expected)) {
      const y = drawn.up(body.expected);
      drawn.svg.append(make("line", { x1: x, x2: x, y1: drawn.up(body.low), y2: drawn.up(body.high), class: "interval" }));
      drawn.svg.append(make("line", { x1: x - 6, x2: x + 6, y1: y, y2: y, class: "expected" }));
    }
    const point = titled(make("g", { class: "choice" }, mark(body.kind, x, drawn.up(body.best))), inWords(body));
    point.addEventListener("click", () => choose(body));
    drawn.svg.append(point);
  }
  drawn.svg.setAttribute("aria-label", "Best return of each body; the numbers are in the table below.");
}

function inWords({ number, kind, best, expected, low, high }) {
  const told = expected === null ? "" : `, expected ${Math.round(expected)} (${Math.round(low)} to ${Math.round(high)})`;
  return `body ${number}, ${kind}: best return ${Math.round(best)}${told}`;
}

// Gain of each length with its interval, a line for each way to estimate it.
function drawGains(place, run, names) {
  const found = Object.entries(run.gains);
  if (!found.length) return place.replaceChildren();
  const ends = found.flatMap(([, gains]) => gains.flatMap(({ low, high }) => [low, high]));
  const low = Math.min(0, ...ends), high = Math.max(0, ...ends), edge = 0.05 * (high - low || 1);
  const left = 16 + 7 * Math.max(...names.map((name) => name.length)), line = 34;
  const drawn = chart(place, {
    height: 66 + line * names.length,
    x: [low - edge, high + edge],
    left,
    below: "change of the return, length a tenth longer",
  });
  const zero = drawn.across(0);
  drawn.svg.append(make("line", { x1: zero, x2: zero, y1: drawn.top, y2: drawn.bottom, class: "axis" }));
  names.forEach((name, i) => {
    const middle = drawn.top + line * (i + 0.5);
    drawn.svg.append(make("text", { x: left - 8, y: middle + 4, "text-anchor": "end" }, name));
    found.forEach(([way, gains], j) => {
      const gain = gains[i], y = middle + (found.length > 1 ? 14 * (j - 0.5) : 0);
      const [from, at, to] = [gain.low, gain.value, gain.high].map(drawn.across);
      const words = `${name}, by the ${way}: ${gain.value.toFixed(1)} (${gain.low.toFixed(1)} to ${gain.high.toFixed(1)})`;
      const estimate = make("g", { class: `way-${way}` });
      estimate.append(make("line", { x1: from, x2: to, y1: y, y2: y, "stroke-width": 3 }));
      estimate.append(make("circle", { cx: at, cy: y, r: 4.5 }));
      drawn.svg.append(titled(estimate, words));
    });
  });
  drawn.svg.setAttribute("aria-label", run.notes.join(" "));
}

// The best body of each run: a line for each length, a point for each run.
function drawBest(place, runs, body, chosen) {
  const left = 16 + 7 * Math.max(...body.names.map((name) => name.length)), line = 30;
  const drawn = chart(place, {
    height: 66 + line * body.names.length,
    x: [Math.min(...body.low), Math.max(...body.high)],
    left,
    below: "scale factor of the length",
  });
  body.names.forEach((name, i) => {
    const y = drawn.top + line * (i + 0.5);
    drawn.svg.append(make("line", { x1: drawn.across(body.low[i]), x2: drawn.across(body.high[i]), y1: y, y2: y, class: "axis" }));
    drawn.svg.append(make("text", { x: left - 8, y: y + 4, "text-anchor": "end" }, name));
    runs.forEach((run, j) => {
      const value = run.bodies[run.best].design[i], marked = run === chosen ? " chosen" : "";
      const point = make("circle", { cx: drawn.across(value), cy: y, r: run === chosen ? 7 : 5, class: `run run-${j % 6}${marked}` });
      drawn.svg.append(titled(point, `${run.name}: ${name} ${value.toFixed(2)}`));
    });
  });
  drawn.svg.setAttribute("aria-label", "Lengths of the best body of each run.");
}

// Capsules in a parallel projection, the farthest first: right and up of both ends and the radius, in m.
function seen(capsules, axes) {
  const along = (axis, point) => axis.reduce((sum, share, i) => sum + share * point[i], 0);
  const found = capsules.map((capsule) => {
    const [start, end] = [capsule.slice(0, 3), capsule.slice(3, 6)].map((point) => axes.map((axis) => along(axis, point)));
    return { near: start[2] + end[2], flat: [start[0], start[1], end[0], end[1], capsule[6]] };
  });
  return found.sort((a, b) => a.near - b.near).map(({ flat }) => flat);
}

// Lowest and highest point of capsules that are seen, in m; the floor at least.
function extent(capsules) {
  const ends = capsules.flatMap(([, low, , high, r]) => [low - r, low + r, high - r, high + r]);
  return [Math.min(0, ...ends), Math.max(...ends)];
}

// A body at rest; `metre` is in pixels, the floor is the lower edge, or where the nearest foot stands.
function drawOutline(body, axes, metre, tallest) {
  const capsules = seen(body.outline, axes), [low] = extent(capsules);
  const xs = capsules.flatMap(([x1, , x2, , r]) => [x1 - r, x1 + r, x2 - r, x2 + r]);
  const left = Math.min(...xs), width = (Math.max(...xs) - left) * metre + 4, height = tallest * metre + 4;
  const svg = make("svg", { width, height, viewBox: `0 0 ${width} ${height}`, class: `kind-${body.kind}`, "aria-hidden": "true" });
  for (const [x1, z1, x2, z2, r] of capsules) {
    const [from, to] = [x1 - left, x2 - left].map((x) => x * metre + 2);
    const [y1, y2] = [z1, z2].map((z) => height - 2 - (z - low) * metre);
    const ends = { x1: from, x2: to + (x1 === x2 && z1 === z2 ? 0.01 : 0), y1, y2 };
    svg.append(make("line", { ...ends, "stroke-width": 2 * r * metre, "stroke-linecap": "round", class: "limb" }));
  }
  return svg;
}
