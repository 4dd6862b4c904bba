"use strict";
// Poses T_a_b are 12 numbers, the rows of a 3 x 4 matrix. Metres; angles of mountings in degrees.
function rotation(rpyDeg) {
  const [roll, pitch, yaw] = rpyDeg.map(function (a) { return a * Math.PI / 180; });
  const cr = Math.cos(roll), sr = Math.sin(roll), cp = Math.cos(pitch), sp = Math.sin(pitch), cy = Math.cos(yaw), sy = Math.sin(yaw);
  // R = Rz(yaw) Ry(pitch) Rx(roll).
  return [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr];
}
function poseOf(xyz, rpyDeg) {
  const R = rotation(rpyDeg);
  return [R[0], R[1], R[2], xyz[0], R[3], R[4], R[5], xyz[1], R[6], R[7], R[8], xyz[2]];
}
function compose(A, B) {
  const out = new Array(12);
  for (let i = 0; i < 12; i += 4) {
    for (let j = 0; j < 4; j += 1) { out[i + j] = A[i] * B[j] + A[i + 1] * B[4 + j] + A[i + 2] * B[8 + j] + (j === 3 ? A[i + 3] : 0); }
  }
  return out;
}
function inverse(T) {
  const out = [T[0], T[4], T[8], 0, T[1], T[5], T[9], 0, T[2], T[6], T[10], 0];
  for (let i = 0; i < 12; i += 4) { out[i + 3] = -(out[i] * T[3] + out[i + 1] * T[7] + out[i + 2] * T[11]); }
  return out;
}
function apply(T, p) {
  return [0, 4, 8].map(function (i) { return T[i] * p[0] + T[i + 1] * p[1] + T[i + 2] * p[2] + T[i + 3]; });
}
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

// Little-endian 16-bit integers.
function decoded(base64) {
  const text = atob(base64), out = new Int16Array(text.length / 2);
  for (let i = 0; i < out.length; i += 1) { out[i] = (text.charCodeAt(2 * i + 1) << 8) | text.charCodeAt(2 * i); }
  return out;
}
function channels(colour) {
  return [1, 3, 5].map(function (i) { return parseInt(colour.slice(i, i + 2), 16); });
}

const SHADES = 32, SPAN_M = 1.5;
// A parallel projection of points, drawn without WebGL: it needs no graphics card and no driver.
class View {
  constructor(canvas, paint) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.paint = paint;
    this.camera = { centre: [0, 0, 0], azimuth: -140, elevation: 35, scale: 20 };
    this.waiting = false;
    new ResizeObserver(this.request.bind(this)).observe(canvas);
  }
  // At most once per picture of the screen, however fast a slider moves.
  request() {
    if (this.waiting) { return; }
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }
  axes() {
    const a = this.camera.azimuth * Math.PI / 180, e = this.camera.elevation * Math.PI / 180;
    const ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
    return { right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce], towards: [ce * ca, ce * sa, se] };
  }
  fit(points, least) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const p of points) {
      for (let i = 0; i < 3; i += 1) { low[i] = Math.min(low[i], p[i]); high[i] = Math.max(high[i], p[i]); }
    }
    if (!points.length) { low.fill(0); high.fill(0); }
    this.camera.centre = low.map(function (v, i) { return (v + high[i]) / 2; });
    const { right, up } = this.axes(), size = [0, 0];
    for (let k = 0; k < 8; k += 1) {
      const p = low.map((v, i) => (k >> i & 1 ? high[i] : v) - this.camera.centre[i]);
      [right, up].forEach(function (axis, i) { size[i] = Math.max(size[i], 2 * Math.abs(axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2])); });
    }
    const w = this.canvas.clientWidth || 600, h = this.canvas.clientHeight || 400;
    this.camera.scale = Math.min(w / (size[0] + least), h / (size[1] + least));
  }
  draw() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), canvas = this.canvas;
    const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (!w || !h) { return; }
    if (canvas.width !== w || canvas.height !== h || !this.pixels) {
      canvas.width = w; canvas.height = h;
      this.image = this.context.createImageData(w, h);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.depth = new Float32Array(w * h);
    }
    this.ratio = ratio;
    this.style = getComputedStyle(document.documentElement);
    this.paper = channels(this.colour("--sheet"));
    this.pixels.fill(this.packed(this.paper));
    this.depth.fill(-Infinity);
    this.lines = [];
    this.paint(this);
    this.context.putImageData(this.image, 0, 0);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.bar();
    for (const overlay of this.lines) { overlay(this.context); }
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    canvas.dataset.drawn = "yes";
  }
  colour(name) { return this.style.getPropertyValue(name).trim(); }
  packed(c) { return (255 << 24 | c[2] << 16 | c[1] << 8 | c[0]) >>> 0; }
  // Low points are faint: the ground must not hide what stands on it.
  cloud(cloud, quantum, T, colour, groundZ, size) {
    const base = channels(colour), shades = new Uint32Array(SHADES);
    for (let k = 0; k < SHADES; k += 1) {
      const part = 0.15 + 0.85 * k / (SHADES - 1);
      shades[k] = this.packed(base.map((v, i) => Math.round(part * v + (1 - part) * this.paper[i])));
    }
    const { right, up, towards } = this.axes(), c = this.camera.centre, ratio = this.ratio;
    const w = this.canvas.width, h = this.canvas.height, pixels = this.pixels, depth = this.depth, s = this.camera.scale * ratio;
    let at = 0;
    for (const [count, T_view_vehicle] of cloud.pieces) {
      const A = compose(T_view_vehicle, T);
      const rows = [[right, s], [up, -s], [towards, 1], [[0, 0, 1], (SHADES - 1) / SPAN_M]].map(function ([axis, factor]) {
        const row = [0, 1, 2, 3].map(function (j) { return factor * (axis[0] * A[j] + axis[1] * A[4 + j] + axis[2] * A[8 + j]); });
        return [row[0] * quantum, row[1] * quantum, row[2] * quantum, row[3], factor * (axis[0] * c[0] + axis[1] * c[1] + axis[2] * c[2])];
      });
      const [X, Y, D, Z] = rows, x0 = X[3] - X[4] + w / 2, y0 = Y[3] - Y[4] + h / 2, d0 = D[3] - D[4];
      const z0 = Z[3] - groundZ * (SHADES - 1) / SPAN_M, end = at + 3 * count, p = cloud.xyz;
      for (; at < end; at += 3) {
        const a = p[at], b = p[at + 1], e = p[at + 2];
        const x = Math.round(X[0] * a + X[1] * b + X[2] * e + x0), y = Math.round(Y[0] * a + Y[1] * b + Y[2] * e + y0);
        if (x < 0 || y < 0 || x >= w - size || y >= h - size) { continue; }
        const d = D[0] * a + D[1] * b + D[2] * e + d0;
        const shade = shades[Math.max(0, Math.min(SHADES - 1, Math.round(Z[0] * a + Z[1] * b + Z[2] * e + z0)))];
        for (let dy = 0; dy < size; dy += 1) {
          for (let i = (y + dy) * w + x, stop = i + size; i < stop; i += 1) {
            if (d >= depth[i]) { depth[i] = d; pixels[i] = shade; }
          }
        }
      }
    }
  }
  project(p) {
    const { right, up } = this.axes(), c = this.camera.centre, s = this.camera.scale;
    const q = [p[0] - c[0], p[1] - c[1], p[2] - c[2]];
    const along = function (axis) { return axis[0] * q[0] + axis[1] * q[1] + axis[2] * q[2]; };
    return [this.canvas.clientWidth / 2 + s * along(right), this.canvas.clientHeight / 2 - s * along(up)];
  }
  line(points, colour, width, closed) {
    const ends = points.map(this.project, this);
    this.lines.push(function (context) {
      context.beginPath();
      ends.forEach(function ([x, y], i) { if (i) { context.lineTo(x, y); } else { context.moveTo(x, y); } });
      if (closed) { context.closePath(); }
      context.strokeStyle = colour; context.lineWidth = width; context.stroke();
    });
  }
  dots(points, colour, radius) {
    const ends = points.map(this.project, this);
    this.lines.push(function (context) {
      context.fillStyle = colour;
      for (const [x, y] of ends) { context.fillRect(x - radius, y - radius, 2 * radius, 2 * radius); }
    });
  }
  text(p, words, colour) {
    const [x, y] = this.project(p), paper = this.colour("--sheet");
    this.lines.push(function (context) {
      context.font = "13px system-ui, 'Liberation Sans', sans-serif";
      context.lineWidth = 3; context.strokeStyle = paper; context.strokeText(words, x + 6, y - 5);
      context.fillStyle = colour; context.fillText(words, x + 6, y - 5);
    });
  }
  // The scale, in a corner.
  bar() {
    const wide = 90 / this.camera.scale, power = Math.pow(10, Math.floor(Math.log10(wide)));
    const metres = power * [5, 2, 1].find(function (n) { return n * power <= wide; });
    const ink = this.colour("--ink"), y = this.canvas.clientHeight - 12, end = 12 + metres * this.camera.scale;
    this.lines.push(function (context) {
      context.strokeStyle = ink; context.fillStyle = ink; context.lineWidth = 2;
      context.beginPath(); context.moveTo(12, y - 5); context.lineTo(12, y); context.lineTo(end, y); context.lineTo(end, y - 5); context.stroke();
      context.font = "12px system-ui, 'Liberation Sans', sans-serif";
      context.fillText(Number(metres.toPrecision(1)) + " m", 17, y - 5);
    });
  }
  // x red, y green, z blue.
  frame(T, length, width) {
    const origin = apply(T, [0, 0, 0]);
    ["--x", "--y", "--z"].forEach((name, i) => {
      const tip = [0, 0, 0]; tip[i] = length;
      this.line([origin, apply(T, tip)], this.colour(name), width);
    });
  }
  pan(dx, dy) {
    const { right, up } = this.axes(), s = this.camera.scale;
    this.camera.centre = this.camera.centre.map(function (v, i) { return v - right[i] * dx / s + up[i] * dy / s; });
    this.request();
  }
  turn(dx, dy) {
    this.camera.azimuth -= 0.4 * dx;
    this.camera.elevation = Math.max(-90, Math.min(90, this.camera.elevation + 0.4 * dy));
    this.request();
  }
  // Keeps what is under the pointer where it is.
  zoom(factor, x, y) {
    const dx = x - this.canvas.clientWidth / 2, dy = y - this.canvas.clientHeight / 2;
    this.pan(-dx, -dy);
    this.camera.scale = Math.max(0.5, Math.min(2000, this.camera.scale * factor));
    this.pan(dx, dy);
  }
}

// One pointer calls `drag`, two zoom and pan. `grab(x, y)` says what a pointer holds. The wheel zooms
// a view that was clicked; else it scrolls the page. Arrows do what `keys` does.
function handle(view, grab, keys) {
  const canvas = view.canvas, held = new Map();
  let drag = null;
  const place = function (event) {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left - canvas.clientLeft, event.clientY - box.top - canvas.clientTop];
  };
  canvas.addEventListener("pointerdown", function (event) {
    try { canvas.setPointerCapture(event.pointerId); } catch (gone) { /* It was released already. */ }
    held.set(event.pointerId, place(event));
    const [x, y] = place(event);
    drag = held.size === 1 ? grab(x, y, event.shiftKey || event.button > 0) : null;
    canvas.focus({ preventScroll: true });
  });
  canvas.addEventListener("pointermove", function (event) {
    if (!held.has(event.pointerId)) { return; }
    const before = Array.from(held.values());
    const [x, y] = place(event), [x0, y0] = held.get(event.pointerId);
    held.set(event.pointerId, [x, y]);
    if (held.size === 1 && drag) { drag(x - x0, y - y0, x, y); }
    if (held.size !== 2) { return; }
    const after = Array.from(held.values());
    const apart = function ([a, b]) { return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const middle = function ([a, b]) { return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]; };
    const m0 = middle(before), m1 = middle(after);
    view.pan(m1[0] - m0[0], m1[1] - m0[1]);
    view.zoom(apart(after) / Math.max(apart(before), 1), m1[0], m1[1]);
  });
  const release = function (event) { held.delete(event.pointerId); drag = null; };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("keydown", function (event) {
    const steps = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] }, step = steps[event.key];
    const factor = { "+": 1.25, "=": 1.25, "-": 0.8 }[event.key];
    if (factor) { view.zoom(factor, canvas.clientWidth / 2, canvas.clientHeight / 2); }
    if (step) { keys(step[0], step[1]); }
    if (factor || step) { event.preventDefault(); }
  });
  canvas.addEventListener("wheel", function (event) {
    if (document.activeElement !== canvas) { return; }
    event.preventDefault();
    const [x, y] = place(event);
    view.zoom(Math.exp(-0.0015 * event.deltaY), x, y);
  }, { passive: false });
}
