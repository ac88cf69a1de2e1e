// Pictures on canvases. Text is drawn, never parsed: names come from devices and model files.

const FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
const PREFIXES = [[1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];

let colours = {};

export function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["card", "line", "text", "quiet", "accent", "arrow",
    "ramp0", "ramp1", "ramp2", "trace0", "trace1", "trace2"]) {
    colours[name] = style.getPropertyValue("--" + name).trim();
  }
  colours.ramp = ["ramp0", "ramp1", "ramp2"].map((name) => rgb(colours[name]));
  colours.dark = colours.ramp[0][0] < 128;
}

function rgb(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

function ramp(x) {
  const at = 2 * Math.min(Math.max(x, 0), 1), from = at < 1 ? 0 : 1;
  return colours.ramp[from].map((c, i) =>
    Math.round(c + (colours.ramp[from + 1][i] - c) * (at - from)));
}

export function classColour(index) {
  const hue = (205 + index * 137.508) % 360; // the golden angle: neighbours differ most
  return `hsl(${hue.toFixed(0)} ${colours.dark ? "62% 62%" : "62% 46%"})`;
}

export function si(value, unit, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  if (unit === "rad" || unit === "K" || unit === "degC" || unit === "") {
    return `${Number(value.toPrecision(digits))} ${unit}`.trim();
  }
  const size = Math.abs(value) < 1e-12 ? 0 : Math.abs(value);
  const [scale, prefix] = PREFIXES.find(([s]) => size >= s * 0.9995) || (size ? PREFIXES.at(-1) : PREFIXES[0]);
  const shown = value / scale;
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(Math.max(Math.abs(shown), 1))));
  return `${size ? shown.toFixed(places) : 0} ${prefix}${unit}`;
}

function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const w = Math.round(width * ratio), h = Math.round(height * ratio);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
  }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = `12px ${FONT}`;
  return [g, width, height];
}

// Return the layout of the map: the centre [x, y] of each element, and the size of a cell.
export function layout(array, width, height) {
  const rows = Math.max(...array.grid.map((c) => c[0])) + 1;
  const columns = Math.max(...array.grid.map((c) => c[1])) + 1;
  const cell = Math.min(width / columns, height / rows);
  const x0 = (width - cell * columns) / 2, y0 = (height - cell * rows) / 2;
  return {
    cell, rows, columns, x0, y0,
    at: array.grid.map(([row, column]) => [x0 + (column + 0.5) * cell, y0 + (row + 0.5) * cell]),
  };
}

// forces: per element {size, across: [right, down] or null}; full: force of a full colour.
export function drawMap(canvas, array, forces, full, chosen) {
  const [g, width, height] = prepare(canvas);
  const where = layout(array, width, height);
  const r = where.cell * 0.36;
  const taken = new Set(array.grid.map((c) => c.join()));
  g.fillStyle = colours.line;
  for (let row = 0; row < where.rows; row++) {
    for (let column = 0; column < where.columns; column++) {
      if (taken.has(`${row},${column}`)) continue;
      g.beginPath();
      g.arc(where.x0 + (column + 0.5) * where.cell, where.y0 + (row + 0.5) * where.cell, 2, 0, 7);
      g.fill();
    }
  }
  array.elements.forEach((name, i) => {
    const [x, y] = where.at[i], force = forces[i];
    const known = force && Number.isFinite(force.size);
    const colour = ramp(known ? force.size / full : 0);
    g.beginPath();
    g.arc(x, y, r, 0, 7);
    if (known) {
      g.fillStyle = `rgb(${colour.join()})`;
      g.fill();
    }
    g.setLineDash(known ? [] : [3, 3]);
    g.lineWidth = i === chosen ? 3 : 1;
    g.strokeStyle = i === chosen ? colours.accent : colours.line;
    g.stroke();
    g.setLineDash([]);
    if (where.cell >= 34) {
      const light = 0.3 * colour[0] + 0.59 * colour[1] + 0.11 * colour[2] > 140;
      g.fillStyle = known ? (light ? "#26323e" : "#f2f5f8") : colours.quiet;
      g.globalAlpha = i === chosen ? 1 : 0.75;
      g.font = `${i === chosen ? "bold " : ""}${Math.min(12, where.cell * 0.2)}px ${FONT}`;
      g.textAlign = "center";
      g.textBaseline = "middle";
      g.fillText(name.slice(0, 8), x, y + r * 0.66);
      g.globalAlpha = 1;
    }
  });
  array.elements.forEach((_, i) => {
    const force = forces[i];
    if (!force || !force.across || !Number.isFinite(force.size)) return;
    const [dx, dy] = force.across.map((f) => (f / full) * where.cell * 0.8);
    drawArrow(g, where.at[i][0], where.at[i][1], dx, dy, where.cell * 0.9);
  });
}

function drawArrow(g, x, y, dx, dy, longest) {
  let length = Math.hypot(dx, dy);
  if (length < 4) return;
  if (length > longest) {
    dx *= longest / length;
    dy *= longest / length;
    length = longest;
  }
  const head = Math.min(10, length * 0.5), ux = dx / length, uy = dy / length;
  const bx = x + dx - ux * head, by = y + dy - uy * head;
  const path = () => {
    g.beginPath();
    g.moveTo(x, y);
    g.lineTo(bx, by);
    g.moveTo(x + dx, y + dy);
    g.lineTo(bx - uy * head * 0.55, by + ux * head * 0.55);
    g.lineTo(bx + uy * head * 0.55, by - ux * head * 0.55);
    g.closePath();
  };
  g.lineJoin = "round";
  path();
  g.strokeStyle = colours.card; // a rim, so that it is seen on every colour
  g.lineWidth = 5;
  g.stroke();
  g.strokeStyle = g.fillStyle = colours.arrow;
  g.lineWidth = 2.2;
  g.stroke();
  g.fill();
}

const LEFT = 72, BOTTOM = 18;

function axes(g, width, height, window_s) {
  g.strokeStyle = colours.line;
  g.fillStyle = colours.quiet;
  g.lineWidth = 1;
  g.textBaseline = "alphabetic";
  const every = width < 420 ? 4 : 2;
  for (let s = 0; s <= window_s; s += every) {
    const x = Math.round(width - 1 - (s / window_s) * (width - LEFT)) + 0.5;
    g.beginPath();
    g.moveTo(x, 0);
    g.lineTo(x, height - BOTTOM);
    g.stroke();
    g.textAlign = s === 0 ? "right" : "center";
    g.fillText(s === 0 ? "now" : `−${s} s`, x, height - 4);
  }
}

// frames: [{t, newest, least, most}] of (element, channel) flattened; channels: indices to draw.
export function drawTraces(canvas, frames, array, element, channels, zero, window_s, floor) {
  const [g, width, height] = prepare(canvas);
  const unit = array.units[channels[0]], n = array.channels.length;
  const now = frames.length ? frames.at(-1).t : 0, from = now - window_s * 1000;
  const seen = frames.filter((f) => f.t >= from - 100);
  let top = floor;
  const index = channels.map((c) => element * n + c);
  for (const f of seen) {
    for (const i of index) {
      top = Math.max(top, Math.abs(f.least[i] - zero[i]) || 0, Math.abs(f.most[i] - zero[i]) || 0);
    }
  }
  top *= 1.08;
  axes(g, width, height, window_s);
  const middle = (height - BOTTOM) / 2;
  const x = (t) => LEFT + ((t - from) / (window_s * 1000)) * (width - LEFT);
  const y = (v) => middle - (v / top) * (middle - 2);
  g.textAlign = "right";
  g.textBaseline = "middle";
  g.fillStyle = colours.quiet;
  const tick = top / 1.08;
  [[tick, y(tick) + 4], [0, middle], [-tick, y(-tick) - 4]].forEach(([v, at]) =>
    // A label that is too long is squeezed: cut, it would lose its sign.
    g.fillText(v ? si(v, unit, 2) : "0", LEFT - 6, at, LEFT - 8));
  g.strokeStyle = colours.quiet;
  g.globalAlpha = 0.5;
  g.beginPath();
  g.moveTo(LEFT, middle);
  g.lineTo(width, middle);
  g.stroke();
  g.globalAlpha = 1;
  g.save();
  g.beginPath();
  g.rect(LEFT, 0, width - LEFT, height - BOTTOM);
  g.clip();
  index.forEach((i, k) => {
    g.strokeStyle = g.fillStyle = colours["trace" + (k % 3)];
    g.lineWidth = 1.5;
    g.lineJoin = "round";
    for (const run of runs(seen, i)) {
      g.beginPath();
      // Between frames only the range of the values is known: a band from the least to the most.
      const between = (f, k) => x(k ? (run[k - 1].t + f.t) / 2 : f.t);
      run.forEach((f, k) => g.lineTo(between(f, k), y(f.most[i] - zero[i])));
      for (let k = run.length - 1; k >= 0; k--) {
        g.lineTo(between(run[k], k), y(run[k].least[i] - zero[i]));
      }
      g.globalAlpha = 0.3;
      g.fill();
      g.globalAlpha = 1;
      g.beginPath();
      run.forEach((f) => g.lineTo(x(f.t), y(f.newest[i] - zero[i])));
      g.stroke();
    }
  });
  g.restore();
}

// Split frames into runs without a gap, in which value i is known.
function runs(frames, i) {
  const found = [];
  let last = -Infinity;
  for (const f of frames) {
    if (!Number.isFinite(f.newest[i])) {
      last = -Infinity;
      continue;
    }
    if (f.t - last > 500) found.push([]);
    found.at(-1).push(f);
    last = f.t;
  }
  return found;
}

// decisions: [{t, from, p: {label: probability}}], oldest first; order: labels to stack, bottom up.
export function drawProbabilities(canvas, decisions, order, index, now, window_s) {
  const [g, width, height] = prepare(canvas);
  axes(g, width, height, window_s);
  const bottom = height - BOTTOM, from = now - window_s * 1000;
  const x = (t) => LEFT + ((t - from) / (window_s * 1000)) * (width - LEFT);
  g.textAlign = "right";
  g.textBaseline = "middle";
  [[1, 7], [0.5, bottom / 2], [0, bottom - 5]].forEach(([v, at]) => g.fillText(`${100 * v} %`, LEFT - 6, at));
  g.save();
  g.beginPath();
  g.rect(LEFT, 0, width - LEFT, bottom);
  g.clip();
  for (const d of decisions) {
    if (d.t < from) continue;
    const left = x(d.from), wide = Math.max(x(d.t) - left, 1);
    let at = bottom;
    for (const label of order) {
      const tall = (d.p[label] || 0) * bottom;
      if (tall < 0.3) continue;
      g.fillStyle = classColour(index.get(label));
      g.fillRect(left, at - tall, wide + 0.6, tall);
      at -= tall;
    }
  }
  g.restore();
}

export function traceColour(k) {
  return colours["trace" + (k % 3)];
}
