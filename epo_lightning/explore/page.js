// The page of `epo explore`. It keeps the changes of a game (`edit`), asks the server for the solution after each one, and draws it.
"use strict";

const COLOURS = ["#1d6fa5", "#d1642a", "#2f8f5b", "#8a4fa0", "#b3912b", "#c04567", "#3c9a9f", "#6b6f76"];
const SVG = "http://www.w3.org/2000/svg";
const OCTAVES = 5;  // sliders reach from 2^-5 to 2^5; the leftmost place is zero
const find = (id) => document.getElementById(id);
const colour = (agent) => COLOURS[agent % COLOURS.length];
const fixed = (value, digits) => (value === null ? "–" : value.toFixed(digits));

let scene = null;       // what /scenes/<index> says
let solution = null;    // what /solve said last
let edit = {};          // changes of the scene's game
let asking = false, again = false;
let opened = 0;         // number of scenes that were asked for
let view = null;        // [x, y, width, height] of the drawing in m
let dragging = null;

function fresh(index) {
  return { scene: index, mode: null, factors: {}, goals: {}, states: {}, absent: [], pair_terms: true };
}

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

async function ask(address, body) {
  const answer = await fetch(address, body && { method: "POST", body: JSON.stringify(body) });
  const values = await answer.json();
  if (!answer.ok) throw new Error(values.error);
  return values;
}

function complain(error) {
  find("error").textContent = error ? error.message : "";
  find("error").hidden = !error;
}

// One question at a time: while one is on its way, only the newest changes wait.
async function solve() {
  if (asking) { again = true; return; }
  asking = true;
  try {
    const began = performance.now(), asked = edit;
    const answer = await ask("/solve", asked);
    if (asked === edit) {  // the answer to changes of another scene is late
      solution = answer;
      complain(null);
      show();
    }
    document.body.dataset.answers = Number(document.body.dataset.answers || 0) + 1;
    document.body.dataset.milliseconds = performance.now() - began;
  } catch (error) {
    complain(error);
  }
  asking = false;
  if (again) { again = false; solve(); }
}

async function open(index) {
  const turn = ++opened;
  try {
    const answer = await ask(`/scenes/${index}`);
    if (turn !== opened) return;
    scene = answer;
  } catch (error) { if (turn === opened) complain(error); return; }
  solution = null;
  dragging = null;
  find("drawing").replaceChildren();
  edit = fresh(index);
  view = null;
  find("title").textContent = scene.title;
  find("subset").textContent = scene.subset || "";
  find("scene").value = index;
  find("scene").max = scene.count - 1;
  find("pair-terms").checked = true;
  find("pair-terms").disabled = !scene.pair.length;
  controls();
  await solve();
}

function controls() {
  find("agents").replaceChildren(...scene.agents.map((agent) => {
    const box = element("input", { type: "checkbox", "data-agent": agent.number, onchange: (event) => {
      edit.absent = edit.absent.filter((other) => other !== agent.number);
      if (!event.target.checked) edit.absent.push(agent.number);
      solve();
    } });
    box.checked = true;
    const swatch = element("span", { class: "swatch" });
    swatch.style.background = colour(agent.number);
    return element("label", {}, box, swatch, `${agent.number} ${agent.kind}`);
  }));
  find("weights").replaceChildren(...scene.weighted.flat().map((name) => {
    const factor = element("output", {}, "× 1");
    const slider = element("input", { type: "range", min: -OCTAVES - 0.1, max: OCTAVES, step: 0.1, "data-weight": name, "aria-label": name });
    slider.value = 0;
    const change = () => {
      const octave = Number(slider.value);
      const value = octave < -OCTAVES ? 0 : 2 ** octave;
      if (octave === 0) delete edit.factors[name];
      else edit.factors[name] = value;
      factor.textContent = `× ${Number(value.toPrecision(2))}`;
      solve();
    };
    slider.addEventListener("input", change);
    slider.addEventListener("dblclick", () => { slider.value = 0; change(); });
    return element("label", { class: "weight" }, name, slider, factor);
  }));
}

function show() {
  const milliseconds = solution.milliseconds;
  find("energy").textContent = fixed(solution.energy, 1);
  find("gap").textContent = solution.nash_gap === null ? "–" : solution.nash_gap.toPrecision(2);
  find("solver").textContent = `${fixed(milliseconds.solver, 1)} ms`;
  find("all").textContent = `${fixed(milliseconds.all, 0)} ms`;
  find("modes").replaceChildren(...solution.modes.map((mode, number) => element("button", {
    "aria-pressed": number === solution.mode, "data-mode": number, title: `joint mode ${number + 1}`,
    onclick: () => { edit.mode = number; solve(); },
  }, `${(100 * mode.probability).toFixed(0)} %`)));
  energies();
  draw();
}

function energies() {
  const agents = solution.present;
  const pairs = scene.pairs.map((pair, place) => ({ pair, place })).filter(({ pair }) => pair.every((agent) => agents.includes(agent)));
  const largest = Math.max(1e-9, ...Object.values(solution.own_energy).flat(), ...Object.values(solution.pair_energy).flat());
  const cell = (value) => {
    const made = element("td", {}, value.toFixed(value < 10 ? 2 : 0));
    made.style.setProperty("--share", `${100 * value / largest}%`);
    return made;
  };
  const heading = (name, columns) => element("thead", {}, element("tr", {}, element("th", {}, name), ...columns.map((text) => element("th", {}, text))));
  const body = (values, places) => element("tbody", {}, ...Object.entries(values).map(([name, row]) =>
    element("tr", { "data-feature": name }, element("th", {}, name), ...places.map((place) => cell(row[place])))));
  const parts = [heading("agent", agents.map(String)), body(solution.own_energy, agents)];
  if (pairs.length && scene.pair.length) {
    parts.push(heading("pair", pairs.map(({ pair }) => pair.join("–"))), body(solution.pair_energy, pairs.map(({ place }) => place)));
  }
  find("energies").replaceChildren(...parts);
}

function line(points, attributes) {
  return shape("polyline", { class: "path", points: points.map(([x, y]) => `${x},${-y}`).join(" "), ...attributes });
}

// The part of the plane with all positions of the unchanged game; it stays as it is while the game is changed.
function extent() {
  const points = scene.agents.flatMap((agent) => [...agent.history, ...(agent.future || [])]);
  for (const mode of solution.modes) points.push(...Object.values(mode.states).flat(), ...Object.values(mode.goals));
  const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const margin = 0.06 * Math.max(right - left, high - low) + 0.5;
  return [left - margin, -high - margin, right - left + 2 * margin, high - low + 2 * margin];
}

function outline(agent, state) {
  const [x, y, heading] = state;
  const [length, width] = agent.size;
  const turn = `translate(${x} ${-y}) rotate(${-heading * 180 / Math.PI})`;
  const look = { fill: colour(agent.number), "fill-opacity": 0.35, transform: turn, "data-outline": agent.number };
  return agent.disc
    ? shape("circle", { r: length / 2, ...look })
    : shape("rect", { x: -length / 2, y: -width / 2, width: length, height: width, rx: width / 6, ...look });
}

function draw() {
  if (!solution) return;  // of a scene that has just been opened
  view = view || extent();
  const drawing = find("drawing");
  drawing.setAttribute("viewBox", view.join(" "));
  const unit = Math.max(view[2] / drawing.clientWidth, view[3] / drawing.clientHeight);  // a pixel in m
  const parts = scene.lanes.map(([x, y, u, v]) => shape("line", { class: "lane", x1: x, y1: -y, x2: u, y2: -v }));
  const chosen = solution.modes[solution.mode];
  const step = Number(find("time").value);
  find("time").max = Object.values(chosen.states)[0].length;
  find("seconds").textContent = `${(step * scene.dt).toFixed(1)} s`;
  for (const agent of scene.agents) {
    const number = agent.number, there = solution.present.includes(number);
    const stroke = { stroke: colour(number) };
    const group = shape("g", { class: there ? "" : "absent", "data-agent": number });
    group.append(line(agent.history, { ...stroke, "stroke-width": 1.5, "stroke-opacity": 0.5 }));
    if (agent.future) group.append(line(agent.future, { ...stroke, "stroke-width": 2, "stroke-dasharray": "1 5", "stroke-linecap": "round" }));
    const now = solution.states[number] || agent.state;
    if (there) {
      solution.modes.forEach((mode, place) => {
        const path = [now, ...mode.states[number]];
        if (place !== solution.mode) group.append(line(path, { ...stroke, "stroke-width": 1, "stroke-opacity": 0.45, "data-mode": place }));
      });
      if (chosen.start[number]) group.append(line([now, ...chosen.start[number]], { ...stroke, "stroke-width": 1.5, "stroke-dasharray": "5 4" }));
      group.append(line([now, ...chosen.states[number]], { ...stroke, "stroke-width": 3.5, "data-mode": solution.mode, "data-chosen": number }));
      group.append(outline(agent, step ? chosen.states[number][step - 1] : now));
      const goal = chosen.goals[number];
      if (goal) {
        const [x, y] = [goal[0], -goal[1]], reach = 7 * unit;
        group.append(shape("path", { class: "path", ...stroke, "stroke-width": 2.5, d: `M${x - reach} ${y - reach}l${2 * reach} ${2 * reach}m0 ${-2 * reach}l${-2 * reach} ${2 * reach}` }));
        group.append(handle("goal", number, x, y, unit));
      }
      const [x, y, heading, speed] = now;
      const tip = [x + speed * Math.cos(heading), y + speed * Math.sin(heading)];
      group.append(line([now, tip], { ...stroke, "stroke-width": 2 }));
      group.append(shape("circle", { cx: x, cy: -y, r: 4 * unit, fill: colour(number) }));
      group.append(handle("velocity", number, tip[0], -tip[1], unit), handle("state", number, x, -y, unit));
    }
    parts.push(group);
  }
  drawing.replaceChildren(...parts);
}

function handle(what, agent, x, y, unit) {
  return shape("circle", { class: "handle", cx: x, cy: y, r: 10 * unit, fill: "transparent", "data-drag": what, "data-agent": agent });
}

// Position of a pointer in m.
function place(event) {
  const drawing = find("drawing");
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(drawing.getScreenCTM().inverse());
  return [point.x, -point.y];
}

find("drawing").addEventListener("pointerdown", (event) => {
  const { drag, agent } = event.target.dataset;
  if (!drag) return;
  dragging = { what: drag, agent };
  find("drawing").setPointerCapture(event.pointerId);
});
find("drawing").addEventListener("pointermove", (event) => {
  if (!dragging) return;
  const [x, y] = place(event), { what, agent } = dragging;
  if (what === "goal") edit.goals[agent] = [x, y];
  else {
    const now = edit.states[agent] || solution.states[agent];
    edit.states[agent] = what === "state"
      ? [x, y, now[2], now[3]]
      : [now[0], now[1], Math.atan2(y - now[1], x - now[0]), Math.hypot(x - now[0], y - now[1])];
  }
  solve();
});
for (const end of ["pointerup", "pointercancel"]) find("drawing").addEventListener(end, () => { dragging = null; });

find("before").addEventListener("click", () => open(Math.max(0, scene.index - 1)));
find("after").addEventListener("click", () => open(Math.min(scene.count - 1, scene.index + 1)));
find("scene").addEventListener("change", (event) => open(Number(event.target.value)));
find("reset").addEventListener("click", () => open(scene.index));
find("pair-terms").addEventListener("change", (event) => { edit.pair_terms = event.target.checked; solve(); });
find("time").addEventListener("input", draw);
addEventListener("resize", draw);
open(0);
