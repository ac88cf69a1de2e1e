// The page: keeps incoming messages, and draws at most once per frame of the screen.

import { classColour, drawMap, drawProbabilities, drawTraces, layout, readColours, si, traceColour }
  from "./draw.js";
import { Stream } from "./stream.js";

const WINDOW_S = 10, STACKED = 6, SET_SHOWN = 8, EVENTS = 60, STEP_MS = 60;
const HALF_LIFE_MS = 20000; // of the map's scale after a strong touch
const $ = (id) => document.getElementById(id);

const arrays = new Map(); // source: its array
let instance = "", control = false, snapshot = null, before = null;
let source = "", model = "", element = 0;
let frames = [], decisions = [], touching = false, zero = null, full = 0;
let legend = "", arrivals = [], lastFrame = 0, link = "connecting", dirty = true;

function make(tag, text = "", name = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (name) made.className = name;
  return made;
}

function options(select, values, chosen) {
  const same = select.options.length === values.length &&
    values.every((v, i) => select.options[i].value === v);
  if (!same) select.replaceChildren(...values.map((v) => new Option(v, v)));
  if (select.value !== chosen) select.value = chosen;
}

function floats(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

// incoming messages

const take = {
  hello(m) {
    control = m.control;
    if (instance && instance !== m.instance) {
      say(`The daemon was restarted; this page went on by itself at ${clock(Date.now())}.`, 15000);
      forget();
      arrays.clear();
    } else if (link !== "live") say("", 0);
    instance = m.instance;
    // The daemon sends the newest of these again at once.
    $("events").replaceChildren();
    decisions = [];
    $("login").hidden = true;
    $("main").hidden = false;
  },
  array(m) {
    arrays.set(m.source, m);
    if (m.source === source) show();
  },
  frame(m) {
    const array = arrays.get(m.source);
    if (!array || m.source !== source) return;
    const newest = floats(m.newest);
    if (newest.length !== array.elements.length * array.channels.length) return stream.open(source);
    const frame = { t: m.t_ms, newest, least: m.least ? floats(m.least) : newest,
      most: m.most ? floats(m.most) : newest };
    if (frames.length && (frame.t < frames.at(-1).t || frame.t > frames.at(-1).t + 3.6e6)) frames = [];
    frames.push(frame);
    while (frames[0].t < frame.t - (WINDOW_S + 1) * 1000) frames.shift();
    const now = performance.now();
    const peak = Math.max(0, ...forces(array, frame).map((f) => f.size || 0));
    full = Math.max(full * 0.5 ** ((now - (lastFrame || now)) / HALF_LIFE_MS), peak);
    lastFrame = now;
    arrivals.push(now);
    while (arrivals[0] < now - 2000) arrivals.shift();
    dirty = true;
  },
  decision(m) {
    const t = m.t_ns / 1e6, onset = m.onset_ns / 1e6;
    const last = decisions.findLast((d) => d.model === m.model);
    const from = last && last.onset === onset ? last.t : Math.max(onset, t - STEP_MS);
    decisions.push({ t, from, onset, model: m.model, step: m.step, final: m.final, label: m.label,
      p: m.probabilities, prediction_set: m.prediction_set || [], coverage: m.coverage,
      names: m.names || [], names_coverage: m.names_coverage,
      object: m.object || "", touches: m.object_touches });
    if (decisions.length > 2000) decisions.splice(0, 1000);
    dirty = true;
  },
  contact(m) {
    if (m.model === model) touching = m.touching;
    dirty = true;
  },
  health(m) {
    const text = `${m.part} ${m.state}${m.reason ? ": " + m.reason : ""}`;
    const same = [...$("events").children].find((old) => old.dataset.text === text);
    const times = same ? +same.dataset.times + 1 : 1;
    if (same) same.remove();
    const line = make("li");
    line.dataset.text = text;
    line.dataset.times = times;
    line.append(make("time", clock(m.utc_ns / 1e6)),
      make("span", times > 1 ? `${text} (${times} ×)` : text, m.level));
    $("events").prepend(line);
    while ($("events").children.length > EVENTS) $("events").lastChild.remove();
  },
  state(m) {
    before = snapshot && snapshot.pid === m.snapshot.pid ? snapshot : null;
    snapshot = m.snapshot;
    states();
  },
};

const stream = new Stream({
  message(m) {
    if (link !== "live") setLink("live");
    if (Object.hasOwn(take, m.type)) take[m.type](m);
  },
  link(state, reason) {
    if (state === "locked") {
      $("login").hidden = false;
      $("main").hidden = $("degraded").hidden = $("soon").hidden = true;
      say("", 0);
      $("token").focus();
    } else if (state === "full") {
      say(`The daemon is there, but ${reason || "busy"}. Trying again.`, 0);
    } else {
      say(`Connection to the daemon lost since ${lostSince()}. Trying again. ${reason}`, 0);
    }
    setLink(state);
  },
});

let lost = 0;
function lostSince() {
  if (link === "live" || !lost) lost = Date.now();
  return clock(lost);
}

function setLink(state) {
  link = state;
  document.body.classList.toggle("stale", state !== "live");
  if (state !== "live") arrivals = [];
  tellLink();
}

function tellLink() {
  const words = { lost: "not connected", full: "too many browsers", locked: "locked",
    hidden: "paused", connecting: "connecting" };
  const recent = performance.now() - lastFrame < 1500;
  const rate = recent && arrivals.length > 1
    ? Math.round((arrivals.length - 1) / ((arrivals.at(-1) - arrivals[0]) / 1000)) : 0;
  const live = link === "live";
  const text = rate ? `live, ${rate} updates/s` : "connected, no samples";
  $("link").textContent = live ? text : words[link] || link;
  $("link").dataset.rate = live ? rate : 0;
  $("link").className = "chip " + (live ? (rate ? "good" : "warn") : "bad");
}

let silence = 0;
function say(text, ms) {
  clearTimeout(silence);
  $("banner").textContent = text;
  $("banner").hidden = !text;
  if (ms) silence = setTimeout(() => say("", 0), ms);
}

function clock(ms) {
  return new Date(ms).toLocaleTimeString([], { hour12: false });
}

// the choice of source and element

function forget() {
  frames = [];
  decisions = [];
  touching = false;
  zero = null;
  full = 0;
  $("zero").setAttribute("aria-pressed", "false");
  $("zero").textContent = "Zero";
  dirty = true;
}

function choose(name) {
  forget();
  source = name;
  model = "";
  element = central(arrays.get(name));
  show();
  stream.open(source);
}

function central(array) {
  const middle = [0, 1].map((k) => Math.max(...array.grid.map((c) => c[k])) / 2);
  const away = array.grid.map((c) => Math.hypot(c[0] - middle[0], c[1] - middle[1]));
  return away.indexOf(Math.min(...away));
}

function show() {
  const array = arrays.get(source);
  if (!array) return;
  document.body.classList.remove("empty");
  $("empty-card").hidden = true;
  document.title = `${array.name} · tactile_rt`;
  $("title").textContent = array.name;
  const { elements, channels, rate_hz, frame } = array;
  $("subtitle").textContent =
    `${elements.length} elements × ${channels.length} channels, ${+rate_hz.toPrecision(4)} Hz, frame ${frame}`;
  element = Math.min(element, elements.length - 1);
  options($("element"), [...elements], elements[element]);
  $("map-title").textContent = `${quantity(array, groups(array)[0])} at each element`;
  $("arrow-legend").hidden = across(array) === null;
  const cards = groups(array).map((group, k) => {
    const title = make("h3");
    title.append(`${quantity(array, group)}, ${array.units[group[0]]}  `,
      ...group.map((c, i) => {
        const name = make("span", `${array.channels[c]}  `);
        name.style.color = traceColour(i);
        return name;
      }));
    const canvas = make("canvas", "", "trace");
    canvas.id = "trace" + k;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${group.map((c) => array.channels[c]).join(", ")} over time`);
    return [title, canvas];
  });
  $("traces").replaceChildren(...cards.flat());
  dirty = true;
}

// Channels of one unit belong together, three to a picture.
function groups(array) {
  const found = [];
  for (const unit of new Set(array.units)) {
    const all = array.units.flatMap((u, i) => (u === unit ? [i] : []));
    for (let at = 0; at < all.length; at += 3) found.push(all.slice(at, at + 3));
  }
  return found.slice(0, 4);
}

function quantity(array, group) {
  const words = { N: "Force", "N m": "Torque", T: "Field", Pa: "Pressure", rad: "Angle", K: "Temperature" };
  return words[array.units[group[0]]] || "Value";
}

// Return the map's channels along x, y and z; null without x and y.
function across(array) {
  const main = groups(array)[0];
  const [x, y, z] = [/x$/, /y$/, /z$/].map((end) => main.find((c) => end.test(array.channels[c])));
  if (x === undefined || y === undefined) return null;
  return z === undefined ? [x, y] : [x, y, z];
}

function forces(array, frame) {
  const n = array.channels.length, main = groups(array)[0], xyz = across(array);
  return array.elements.map((_, e) => {
    const value = (c) => frame.newest[e * n + c] - (zero ? zero[e * n + c] : 0);
    const vector = xyz && xyz.map(value);
    const part = (axis) => vector.reduce((sum, v, k) => sum + axis[k] * v, 0);
    return { size: Math.hypot(...main.map(value)), across: vector && array.axes[e].map(part) };
  });
}

// states, twice a second

function states() {
  const s = snapshot;
  const names = s.sources.map((p) => p.part.name.slice(7));
  const open = names.filter((name) => arrays.has(name));
  if (!names.includes(source) && open.length) { // the first time, or gone since a reload
    return choose(open.find((name) => s.models.some((m) => m.source === name)) || open[0]);
  }
  options($("source"), names, source);
  $("source-label").hidden = s.sources.length < 2 || !arrays.has(source);
  nothing(s);
  const models = s.models.filter((m) => m.source === source).map((m) => m.part.name.slice(6));
  if (!models.includes(model)) {
    model = models[0] || "";
    dirty = true;
  }
  options($("model"), models, model);
  $("model-label").hidden = models.length < 2;
  const here = s.sources.find((p) => p.part.name === "source." + source);
  $("made-up").hidden = !models.length || !here || !here.url.startsWith("synthetic:");
  $("no-model").hidden = models.length > 0;
  $("by-model").hidden = models.length === 0;
  $("daemon").textContent = "daemon " + s.state;
  $("daemon").className = "chip " + ({ running: "good", degraded: "warn" }[s.state] || "warn");
  tell("degraded", s.diagnostics);
  tell("soon", s.soon);
  const now = s.models.find((m) => m.part.name === "model." + model);
  touching = Boolean(now && now.touching);
  figures(s, now);
  parts(s);
  recording(s.consumers.find((c) => c.kind === "recorder"));
  tellLink();
}

// Show the daemon's sentences, with advice.
function tell(where, diagnostics) {
  $(where).replaceChildren(...diagnostics.map(({ says, do: advice }) => {
    const item = make("li", says);
    if (advice) item.append(make("p", advice));
    return item;
  }));
  $(where).hidden = diagnostics.length === 0;
}

// Without an array there is nothing to draw: say why instead.
function nothing(s) {
  const empty = !arrays.has(source);
  document.body.classList.toggle("empty", empty);
  $("empty-card").hidden = !empty;
  if (!empty) return;
  const words = { starting: "is being opened", waiting: "cannot be opened, and is tried again",
    failed: "is not what it should be, and is not tried again", ended: "is over",
    stopped: "was stopped" };
  $("empty").replaceChildren(...s.sources.map(({ part }) => make("li",
    `${part.name.slice(7)} ${words[part.state] || part.state}${part.reason ? ": " + part.reason : ""}`)));
}

function figures(s, now) {
  const here = s.sources.find((p) => p.part.name === "source." + source);
  const then = before && before.sources.find((p) => p.part.name === "source." + source);
  const tiles = [];
  if (here) {
    const { corrupt, missing, dropped, delivered, duplicates } = here.stats;
    const gone = corrupt + missing + dropped;
    const rate = then ? (here.samples - then.samples) / ((s.t_ns - before.t_ns) / 1e9) : NaN;
    const of = here.measured_hz ? `${+here.measured_hz.toPrecision(3)} Hz measured of ` : "";
    tiles.push(["Samples per second", Number.isFinite(rate) ? rate.toFixed(0) : "–", here.slow,
      `${of}${+here.rate_hz.toPrecision(4)} Hz nominal`]);
    const late = here.losses.minute ? `, ${here.losses.minute} in a minute` : "";
    tiles.push(["Lost samples", `${gone} (${percent(gone, gone + delivered)})${late}`, here.losses.minute > 0,
      `missing ${missing}, corrupt ${corrupt}, dropped ${dropped}, duplicates ${duplicates}`]);
    tiles.push(["Newest sample", here.newest_ns
      ? `${((s.t_ns - here.newest_ns) / 1e6).toFixed(0)} ms ago` : "none yet",
    s.diagnostics.some((t) => t.part === here.part.name && t.what !== "lost samples"), "since it was taken"]);
  }
  if (now) {
    const { p50_ms, p99_ms, count } = now.latency;
    tiles.push(["Sample to decision", count ? `${p50_ms.toFixed(1)} ms` : "–", false, "median"]);
    tiles.push(["99 % of them within", count ? `${p99_ms.toFixed(1)} ms` : "–"]);
    tiles.push(["Decisions", String(now.decisions)]);
  }
  tiles.push(["Daemon up", span((s.t_ns - s.started_ns) / 1e9)]);
  $("figures").replaceChildren(...tiles.map(([what, value, alarm, title]) => {
    const tile = make("div", "", alarm ? "alarm" : "");
    if (title) tile.title = title;
    tile.append(make("dt", what), make("dd", value));
    return tile;
  }));
}

function percent(part, whole) {
  return part === 0 || !whole ? "0 %" : `${(100 * part / whole).toPrecision(2)} %`;
}

function span(s) {
  if (s < 120) return `${s.toFixed(0)} s`;
  if (s < 7200) return `${(s / 60).toFixed(0)} min`;
  return s < 172800 ? `${(s / 3600).toFixed(1)} h` : `${(s / 86400).toFixed(1)} d`;
}

function parts(s) {
  const lines = [];
  const base = (path) => path.split("/").at(-1) || "the shipped model";
  for (const p of s.sources) {
    const facts = p.device ? [`identity: ${p.device.identity}`, p.device.reason, ...new Set([...p.device.faults, ...p.device.status])].filter(Boolean) : [];
    const device = p.device ? `, device ${p.device.state} ${facts.join(", ")}` : "";
    lines.push([p.part, `${p.url}${device}`, p.device && (p.device.state !== "streaming" || p.device.faults.length)]);
  }
  for (const m of s.models) lines.push([m.part, `${base(m.file)} on ${m.source}, ${m.labels.length} labels`]);
  for (const c of s.consumers) {
    const gone = Object.entries(c.queue.dropped).filter(([, n]) => n).map(([k, n]) => `${n} ${k} dropped`);
    const about = Object.entries(c.details).filter(([, v]) => v !== "").map(([k, v]) => `${k.replaceAll("_", " ")} ${v}`);
    lines.push([c.part, [...gone, ...about].join(", ")]);
  }
  $("parts").replaceChildren(...lines.map(([part, about, worry]) => {
    const diagnostic = s.diagnostics.find((t) => t.part === part.name);
    const row = make("tr"), state = make("td", diagnostic && part.state === "running" ? diagnostic.what : part.state);
    const good = part.state === "running" && !worry && !diagnostic;
    state.className = "dot " + (good ? "good" : ["waiting", "stalled", "failed"].includes(part.state) ? "bad" : "warn");
    const again = part.failures ? `broke ${part.failures} ×` : "";
    const why = part.state === "running" ? diagnostic && diagnostic.why : part.reason;
    row.append(make("td", part.name.replace(".", " ")), state,
      make("td", [why, again, about].filter(Boolean).join("; ")));
    return row;
  }));
}

function recording(recorder) {
  $("recording").hidden = $("recorder-chip").hidden = !recorder;
  if (!recorder) return;
  const d = recorder.details;
  const on = recorder.part.state === "running" && d.recording > 0 && !recorder.diagnostic;
  $("recorder-chip").textContent = on ? "recording" : d.state === "on" ? "recorder waits" : `recorder ${d.state || recorder.part.state}`;
  $("recorder-chip").className = "chip " + (on ? "bad" : ["disk full", "no folder"].includes(d.state) ? "warn" : "");
  $("recording-state").textContent = `${on ? "Recording" : "Not recording"} (mode ${d.mode}), ${d.megabytes} MB in ${d.files} ${d.files === 1 ? "file" : "files"}, ${d.lost_samples} samples lost. ${d.newest ? "Newest: " + d.newest : ""}`;
  $("recording-buttons").hidden = !control;
}

// pictures

function draw() {
  requestAnimationFrame(draw);
  if (!dirty) return;
  dirty = false;
  const array = arrays.get(source);
  if (!array) return;
  const unit = array.units[groups(array)[0][0]];
  const newest = frames.at(-1);
  const now = forces(array, newest || { newest: new Float32Array(1e4).fill(NaN) });
  drawMap($("map"), array, now, full || 1, element);
  $("high").textContent = full ? si(full, unit, 2) : "–";
  const n = array.channels.length;
  const offset = zero || new Float32Array(array.elements.length * n);
  groups(array).forEach((group, k) => {
    const floor = array.units[group[0]] === unit ? full * 0.02 || 1e-12 : 1e-12;
    drawTraces($("trace" + k), frames, array, element, group, offset, WINDOW_S, floor);
  });
  $("readout").textContent = newest
    ? `${quantity(array, groups(array)[0]).toLowerCase()} ${si(now[element].size, unit)}` : "";
  decide(newest ? newest.t : (decisions.at(-1) || { t: 0 }).t);
}

function possible(names, coverage) {
  const shown = names.slice(0, SET_SHOWN);
  const more = names.length > shown.length ? ` and ${names.length - shown.length} more` : "";
  return `one of: ${shown.join(", ")}${more} (${Math.round(100 * coverage)} % coverage)`;
}

function sets(decision) {
  const { prediction_set, coverage, names, names_coverage, label, object, touches } = decision;
  return [
    object ? `object: ${object}${touches > 1 ? ` (${touches} touches)` : ""}` : "",
    prediction_set.length ? `if it is of a known kind, ${possible(prediction_set, coverage)}` : "",
    names.length ? `if it is a ${label}, ${possible(names, names_coverage)}` : "",
  ].filter(Boolean).join("; ");
}

function decide(now) {
  const about = snapshot && snapshot.models.find((m) => m.part.name === "model." + model);
  const mine = decisions.filter((d) => d.model === model);
  const recent = mine.filter((d) => d.t > now - WINDOW_S * 1000);
  const last = mine.at(-1);
  const index = new Map((about ? about.labels : Object.keys(last ? last.p : {})).map((l, i) => [l, i]));
  const sums = new Map();
  for (const d of recent) for (const [l, p] of Object.entries(d.p)) sums.set(l, (sums.get(l) || 0) + p);
  const order = [...sums].sort((a, b) => b[1] - a[1]).slice(0, STACKED).map(([l]) => l);
  if (!about) return;
  drawProbabilities($("probabilities"), recent, order, index, now, WINDOW_S);
  if (order.join() !== legend) {
    legend = order.join();
    $("classes").replaceChildren(...order.map((label) => {
      const entry = make("li", label), swatch = make("i");
      swatch.style.background = classColour(index.get(label) || 0);
      entry.prepend(swatch);
      return entry;
    }));
  }
  const past = !last || (!touching && now - last.t > 300);
  $("label").textContent = last ? last.label : "–";
  $("probability").textContent = last ? `${(100 * last.p[last.label]).toFixed(0)} %` : "";
  $("label").parentElement.classList.toggle("past", past);
  $("episode").textContent = !about ? "" : touching
    ? `in contact${last ? `, step ${last.step}${last.final ? " (last)" : ""}` : ""}`
    : last ? `no contact; decided ${Math.max(0, (now - last.t) / 1000).toFixed(0)} s ago` : "no contact yet";
  $("prediction-set").textContent = last ? sets(last) : "";
  const top = last ? Object.entries(last.p).sort((a, b) => b[1] - a[1]).slice(0, 5) : [];
  const list = $("top");
  while (list.children.length < 5) {
    const row = make("li"), rail = make("span", "", "rail");
    rail.append(make("div", "", "bar"));
    row.append(make("span", "", "what"), rail, make("span", "", "value"));
    list.append(row);
  }
  [...list.children].forEach((row, i) => {
    const [label, p] = top[i] || ["", 0];
    row.children[0].textContent = label;
    row.children[1].firstChild.style.width = `${100 * p}%`;
    row.children[1].firstChild.style.background = label ? classColour(index.get(label) || 0) : "";
    row.children[2].textContent = label ? `${(100 * p).toFixed(1)} %` : "";
  });
}

// user input

$("source").addEventListener("change", (e) => {
  if (arrays.has(e.target.value)) choose(e.target.value);
  else say(`${e.target.value} has not been opened yet.`, 4000);
});
$("model").addEventListener("change", (e) => { model = e.target.value; dirty = true; });
$("element").addEventListener("change", (e) => { element = e.target.selectedIndex; dirty = true; });
$("zero").addEventListener("click", () => {
  zero = zero || !frames.length ? null : frames.at(-1).newest.map((v) => (Number.isFinite(v) ? v : 0));
  full = 0;
  $("zero").setAttribute("aria-pressed", String(Boolean(zero)));
  $("zero").textContent = zero ? "Zeroed" : "Zero";
  dirty = true;
});
$("map").addEventListener("click", (e) => {
  const array = arrays.get(source);
  if (!array) return;
  const where = layout(array, e.target.clientWidth, e.target.clientHeight);
  const away = where.at.map(([x, y]) => Math.hypot(x - e.offsetX, y - e.offsetY));
  const nearest = away.indexOf(Math.min(...away));
  if (away[nearest] < where.cell * 0.7) pick(nearest);
});
$("map").addEventListener("keydown", (e) => {
  const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[e.key];
  const array = arrays.get(source);
  if (!step || !array) return;
  e.preventDefault();
  const [row, column] = array.grid[element];
  const to = array.grid.findIndex(([r, c]) => r === row + step[0] && c === column + step[1]);
  if (to >= 0) pick(to);
});

function pick(index) {
  element = index;
  $("element").selectedIndex = index;
  dirty = true;
}

async function post(path, body) {
  try {
    const answer = await fetch(path, { method: "POST", credentials: "same-origin",
      headers: { "content-type": "application/json" }, body: JSON.stringify(body) });
    return [answer.ok, (await answer.text()).slice(0, 200)];
  } catch {
    return [false, "the daemon does not answer"];
  }
}

$("login").addEventListener("submit", async (e) => {
  e.preventDefault();
  $("login-error").textContent = "";
  const [ok, text] = await post("/login", { token: $("token").value });
  $("token").value = "";
  if (ok) stream.open(source);
  else $("login-error").textContent = text;
});
$("recording-buttons").addEventListener("click", async (e) => {
  const action = e.target.dataset.action;
  if (!action) return;
  const [ok, text] = await post("/control", { action });
  $("recording-answer").textContent = ok ? `${e.target.textContent}: ${text}` : text;
});
document.addEventListener("visibilitychange", () => {
  if (link === "locked") return;
  if (document.hidden) {
    stream.close();
    setLink("hidden");
  } else stream.open(source);
});
const theme = matchMedia("(prefers-color-scheme: dark)");
theme.addEventListener("change", () => { readColours(); legend = ""; show(); });
window.addEventListener("resize", () => { dirty = true; });

for (const span of document.querySelectorAll(".window")) span.textContent = WINDOW_S;
readColours();
stream.open("");
requestAnimationFrame(draw);
