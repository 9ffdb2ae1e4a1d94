// The page of the pool: sticks by keys and gamepad, ten times a second to the server, and what comes back, drawn.
"use strict";

const PERIOD = 100; // ms between words to the server
const SLEW = 1 / 0.3; // full sticks per second, as the package's own operator slews
const LEVER = 0.5; // full levers per second
const DEAD = 0.12; // of a gamepad's axis at rest
const TRAIL = 900; // points

const $ = (id) => document.getElementById(id);
const clip = (x) => Math.max(-1, Math.min(1, x));

let craft = null;
let state = null;
let sticks = [];
const held = new Map(); // by what holds it (a key, a button): [stick, way]
const trail = [];

// --- what an operator does ---------------------------------------------------------------------

function keyOf(event) {
  return event.key.length === 1 ? event.key.toLowerCase() : event.key;
}

function way(key) {
  const i = craft.sticks.findIndex((stick) => stick.more === key || stick.less === key);
  return i < 0 ? null : [i, craft.sticks[i].more === key ? 1 : -1];
}

function release() {
  held.clear();
  sticks.fill(0);
}

function listen() {
  addEventListener("keydown", (event) => {
    if (event.target.matches("input[type=number]") || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = keyOf(event);
    if (key === "x") release();
    const pushed = way(key);
    if (!pushed) return;
    event.preventDefault();
    held.set(key, pushed);
  });
  addEventListener("keyup", (event) => held.delete(keyOf(event)));
  addEventListener("blur", () => held.clear());
  for (const button of document.querySelectorAll("button[data-stick]")) {
    const let_go = () => held.delete(button);
    button.addEventListener("pointerdown", (event) => {
      button.setPointerCapture(event.pointerId);
      held.set(button, [Number(button.dataset.stick), Number(button.dataset.way)]);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(end, let_go);
  }
  $("release").addEventListener("click", release);
  for (const box of document.querySelectorAll("input[data-fault]")) box.addEventListener("change", () => flip(box));
  for (const size of document.querySelectorAll("input[data-of]"))
    size.addEventListener("change", () => {
      const box = [...document.querySelectorAll("input[data-fault]")].find((one) => one.dataset.fault === size.dataset.of);
      if (box.checked) flip(box);
    });
}

async function flip(box) {
  const values = {};
  for (const size of document.querySelectorAll("input[data-of]"))
    if (size.dataset.of === box.dataset.fault) values[size.dataset.parameter] = size.valueAsNumber;
  await say("/switch", { fault: box.dataset.fault, on: box.checked, values });
}

function padAxes() {
  const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one && one.connected);
  $("pad").textContent = pad ? `${pad.id}.` : "none is seen; press one of its buttons.";
  return pad ? pad.axes : [];
}

function moveSticks(dt) {
  const axes = padAxes();
  craft.sticks.forEach((stick, i) => {
    const [axis, sign] = stick.pad;
    const pad = sign * (axes[axis] ?? 0);
    let wanted = Math.abs(pad) > DEAD ? pad : 0;
    for (const [which, direction] of held.values()) if (which === i) wanted += direction;
    wanted = clip(wanted);
    if (stick.lever) sticks[i] = clip(sticks[i] + LEVER * dt * wanted);
    else sticks[i] += Math.max(-SLEW * dt, Math.min(SLEW * dt, wanted - sticks[i]));
  });
  for (const button of document.querySelectorAll("button[data-stick]")) {
    const own = [Number(button.dataset.stick), Number(button.dataset.way)];
    button.classList.toggle("down", [...held.values()].some(([i, w]) => i === own[0] && w === own[1]));
  }
}

function commands() {
  const out = Object.fromEntries(craft.columns.map((column) => [column.name, 0]));
  craft.sticks.forEach((stick, i) => {
    for (const [name, full] of Object.entries(stick.columns)) out[name] += full * sticks[i];
  });
  for (const { name, limit } of craft.columns) out[name] = Math.max(-limit, Math.min(limit, out[name]));
  return out;
}

// --- to the server and back --------------------------------------------------------------------

let complaint = "";

async function say(path, what) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(what),
    });
    const said = await answer.json();
    if (answer.ok) {
      if (path === "/switch") complaint = "";
      take(said);
    } else complaint = said.error;
  } catch {
    complaint = "The pool does not answer: it has ended, or was stopped.";
    if (path === "/steer") state = state && { ...state, gone: true };
  }
  news();
}

async function beat() {
  const begun = performance.now();
  moveSticks(PERIOD / 1000);
  await say("/steer", { commands: commands() });
  setTimeout(beat, Math.max(0, PERIOD - (performance.now() - begun)));
}

function take(said) {
  if (complaint.startsWith("The pool does not answer")) complaint = "";
  state = said;
  if (!state.pose) return;
  trail.push(state.pose.slice(0, 3));
  if (trail.length > TRAIL) trail.shift();
  show();
}

// --- what is seen ------------------------------------------------------------------------------

const WORDS = {
  x: ["north", "m", 2], y: ["east", "m", 2], z: ["depth", "m", 2],
  phi: ["roll", "°", 1], theta: ["pitch", "°", 1], psi: ["heading", "°", 1],
  u: ["surge u", "m/s", 2], v: ["sway v", "m/s", 2], w: ["heave w", "m/s", 2],
  p: ["roll rate p", "rad/s", 3], q: ["pitch rate q", "rad/s", 3], r: ["yaw rate r", "rad/s", 3],
};

function news() {
  const faults = Object.keys(state?.faults ?? {});
  const parts = [];
  if (complaint) parts.push(complaint);
  if (state?.failure) parts.push(state.failure);
  if (state?.t !== undefined) parts.push(`${state.t.toFixed(1)} s`);
  if (state?.lost > 0) parts.push(`the simulation is ${state.lost.toFixed(1)} s behind the clock`);
  else if (state?.late > 0.3) parts.push(`${state.late.toFixed(1)} s late, catching up`);
  parts.push(faults.length ? `on: ${faults.join(", ")}` : "no fault is on");
  $("news").textContent = parts.join(" · ");
  $("news").classList.toggle("bad", Boolean(complaint || state?.failure));
}

function text(parent, tag, words) {
  const one = document.createElement(tag);
  one.textContent = words;
  parent.append(one);
  return one;
}

const numbers = new Map();
const bars = new Map();

function furnish() {
  for (const { name, unit, most } of craft.columns) {
    const row = document.createElement("div");
    row.className = "actuator";
    text(row, "span", name);
    const bar = text(row, "div", "");
    bar.className = "bar";
    const given = text(bar, "span", "");
    const told = text(bar, "i", "");
    bars.set(name, { given, told, most, unit, output: text(row, "output", "") });
    $("actuators").append(row);
  }
}

function show() {
  for (const [name, value] of Object.entries(state.shown)) {
    if (!(name in WORDS)) continue;
    const [words, unit, digits] = WORDS[name];
    if (!numbers.has(name)) {
      const row = text($("shown"), "div", "");
      text(row, "dt", words);
      numbers.set(name, text(row, "dd", ""));
    }
    let shown = unit === "°" ? (value * 180) / Math.PI : value;
    if (name === "psi") shown = ((shown % 360) + 360) % 360;
    numbers.get(name).textContent = `${shown.toFixed(digits).replace("-", "−")} ${unit}`;
  }
  for (const { name, limit } of craft.columns) {
    const { given, told, most, unit, output } = bars.get(name);
    const share = clip(state.given[name] / most);
    given.style.left = `${50 + 50 * Math.min(0, share)}%`;
    given.style.width = `${50 * Math.abs(share)}%`;
    told.style.left = `${50 + 49 * clip(state.commands[name] / limit)}%`;
    const digits = unit === "rad" ? 2 : 1;
    output.textContent = `${state.given[name].toFixed(digits).replace("-", "−")} ${unit}`;
  }
  $("rows").textContent = `${state.rows} rows`;
  const on = {};
  for (const label of Object.keys(state.faults)) on[label.split(":")[0]] = "on";
  for (const mark of document.querySelectorAll("[data-effect]")) mark.textContent = on[mark.dataset.effect] ?? "";
  for (const box of document.querySelectorAll("input[data-fault]"))
    if (document.activeElement !== box) box.checked = box.dataset.fault in state.faults;
}

// Outlines in shares of length, beam and height, about the middle: from above, and from the side.
const box = [[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]];
const torpedo = [[0.5, 0], [0.48, 0.3], [0.42, 0.5], [-0.3, 0.5], [-0.5, 0.12], [-0.5, -0.12], [-0.3, -0.5], [0.42, -0.5], [0.48, -0.3]];
const HULLS = {
  tethra: { top: box, side: [[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]] },
  remus100: { top: torpedo, side: torpedo },
  kvlcc2: {
    top: [[0.5, 0], [0.46, 0.28], [0.4, 0.44], [0.32, 0.5], [-0.36, 0.5], [-0.48, 0.36], [-0.5, 0.2], [-0.5, -0.2], [-0.48, -0.36], [-0.36, -0.5], [0.32, -0.5], [0.4, -0.44], [0.46, -0.28]],
    side: [[0.5, -0.25], [0.47, 0.5], [-0.4, 0.5], [-0.47, 0.1], [-0.5, -0.2], [-0.46, -0.2], [-0.46, -0.9], [-0.38, -0.9], [-0.38, -0.2]],
  },
  milliampere: {
    top: [[0.5, -0.32], [0.5, 0.32], [0.42, 0.5], [-0.42, 0.5], [-0.5, 0.32], [-0.5, -0.32], [-0.42, -0.5], [0.42, -0.5]],
    side: [[0.5, -0.1], [0.42, 0.5], [-0.42, 0.5], [-0.5, -0.1], [-0.3, -0.1], [-0.3, -0.9], [0.3, -0.9], [0.3, -0.1]],
  },
};

function rotation([phi, theta, psi]) {
  const [a, b, c] = [phi, theta, psi].map(Math.cos);
  const [d, e, f] = [phi, theta, psi].map(Math.sin);
  return [
    [c * b, c * e * d - f * a, c * e * a + f * d],
    [f * b, f * e * d + c * a, f * e * a - c * d],
    [-e, b * d, b * a],
  ];
}

const times = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
const plus = (a, b, k = 1) => a.map((one, i) => one + k * b[i]);

// Right-handed about a unit axis (Rodrigues).
function turned(v, axis, angle) {
  const cross = [axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2], axis[0] * v[1] - axis[1] * v[0]];
  const along = (axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]) * (1 - Math.cos(angle));
  return v.map((one, i) => one * Math.cos(angle) + cross[i] * Math.sin(angle) + axis[i] * along);
}

// Metres across the view, and where its middle is: it follows when the craft nears the edge.
const cameras = { top: null, side: null };

function draw(id) {
  const canvas = $(id);
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  if (!craft || !state?.pose) return;
  const style = getComputedStyle(document.documentElement);
  const ink = (name) => style.getPropertyValue(`--${name}`).trim();
  const [position, attitude] = [state.pose.slice(0, 3), state.pose.slice(3)];
  const turn = rotation(attitude);
  const [length, beam, tall] = craft.size;
  const span = 9 * length;
  const scale = width / span;
  // From the side: along the heading to the right, so that the bow points there, and depth downwards.
  const [c, s] = [Math.cos(attitude[2]), Math.sin(attitude[2])];
  const flat = id === "top" ? (p) => [p[1], -p[0]] : (p) => [(p[0] - position[0]) * c + (p[1] - position[1]) * s, p[2]];
  const at = flat(position);
  const camera = (cameras[id] ??= [...at]);
  [0, 1].forEach((k) => {
    const room = (0.3 * (k ? height : width)) / scale;
    camera[k] = Math.max(at[k] - room, Math.min(at[k] + room, camera[k]));
  });
  const pixel = ([x, y]) => [width / 2 + (x - camera[0]) * scale, height / 2 + (y - camera[1]) * scale];
  const path = (points, closed) => {
    pen.beginPath();
    points.forEach((p, i) => pen[i ? "lineTo" : "moveTo"](...pixel(p)));
    if (closed) pen.closePath();
  };

  // A grid of a metre, or of ten; from the side the surface, and depths.
  const grid = length > 3 ? 10 : 1;
  pen.lineWidth = 1;
  pen.strokeStyle = ink("grid");
  pen.fillStyle = ink("soft");
  pen.font = "11px system-ui, sans-serif";
  const [left, right] = [camera[0] - width / 2 / scale, camera[0] + width / 2 / scale];
  const [above, below] = [camera[1] - height / 2 / scale, camera[1] + height / 2 / scale];
  if (id === "top")
    for (let x = Math.ceil(left / grid) * grid; x < right; x += grid) (path([[x, above], [x, below]]), pen.stroke());
  for (let y = Math.ceil(above / grid) * grid; y < below; y += grid) {
    if (id === "side" && y < 0) continue;
    path([[left, y], [right, y]]);
    pen.stroke();
    if (id === "side" && y > 0) pen.fillText(`${y} m`, 4, pixel([0, y])[1] - 3);
  }
  if (id === "side" && above < 0) {
    pen.strokeStyle = ink("after");
    pen.lineWidth = 1.5;
    path([[left, 0], [right, 0]]);
    pen.stroke();
  }
  if (id === "top") pen.fillText(`grid ${grid} m`, 4, height - 5);

  pen.strokeStyle = ink("quiet");
  pen.lineWidth = 1.5;
  path(trail.map(flat));
  pen.stroke();

  const body = (p) => flat(plus(position, times(turn, p)));
  const outline = HULLS[craft.hull][id].map(([a, b]) =>
    body(plus(craft.middle, id === "top" ? [a * length, b * beam, 0] : [a * length, 0, b * tall])),
  );
  pen.fillStyle = ink("mark");
  pen.strokeStyle = ink("ink");
  pen.lineWidth = 2;
  path(outline, true);
  pen.fill();
  pen.stroke();
  if (id === "top") {
    // Which end is the bow.
    pen.fillStyle = ink("ink");
    path([[0.44, 0], [0.3, -0.16], [0.3, 0.16]].map(([a, b]) => body(plus(craft.middle, [a * length, b * beam, 0]))), true);
    pen.fill();
  }
  pen.strokeStyle = ink("before");
  pen.lineWidth = 3;
  for (const one of craft.pushers) {
    const { most } = bars.get(one.name);
    const share = state.given[one.name] / most;
    const angle = one.swivel ? state.given[`${one.name}_angle`] : 0;
    const way = one.swivel ? turned(one.direction, one.swivel, angle) : one.direction;
    arrow(pen, pixel(body(one.position)), pixel(body(plus(one.position, way, 0.5 * length * share))));
  }
  for (const one of craft.surfaces) {
    const tail = turned([-0.12 * length, 0, 0], one.axis, state.given[one.name] ?? 0);
    path([body(one.position), body(plus(one.position, tail))]);
    pen.stroke();
  }
}

function arrow(pen, [a, b], [c, d]) {
  const size = Math.hypot(c - a, d - b);
  if (size < 2) return;
  const head = Math.min(7, size);
  const [x, y] = [((c - a) / size) * head, ((d - b) / size) * head];
  pen.beginPath();
  pen.moveTo(a, b);
  pen.lineTo(c, d);
  pen.moveTo(c - x - 0.6 * y, d - y + 0.6 * x);
  pen.lineTo(c, d);
  pen.lineTo(c - x + 0.6 * y, d - y - 0.6 * x);
  pen.stroke();
}

function frame() {
  draw("top");
  draw("side");
  requestAnimationFrame(frame);
}

async function begin() {
  craft = await (await fetch("/craft.json")).json();
  sticks = craft.sticks.map(() => 0);
  furnish();
  listen();
  beat();
  frame();
}

begin();
