"use strict";

/** Value of a CSS variable of the page. */
function cssColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}

/** Numbers from base64 text: little-endian float32, or bytes. */
function decode(text, kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return kind === Uint8Array ? bytes : new Float32Array(bytes.buffer);
}

/**
 * Orbit view of a world on a 2-D canvas.
 *
 * Scene coordinates are right, forward, up: the rows of `world.basis` in world coordinates. The camera turns about a
 * target point: `yaw` about the up axis, `pitch` above the horizon, `distance` away.
 */
class OrbitView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.layers = { map: true, truth: true, keyframes: true, loops: true, image: true, grid: true };
    this.pose = null; // of the frame at the cursor: x y z qx qy qz qw
    this.picture = null; // image of the frame at the cursor, or of the one with an image that is nearest in time
    this.pictureTime = 0; // of that frame, seconds
    this.pending = false;
    this.listen();
  }

  show(world) {
    this.world = world;
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const [floor, gain] = dark ? [45, 0.82] : [0, 0.82]; // keeps points apart from the background
    this.pointColours = [];
    for (let k = 0; k < world.colors.length; k += 3) {
      const [r, g, b] = [0, 1, 2].map((c) => Math.round(floor + gain * world.colors[k + c]));
      this.pointColours.push(`rgb(${r},${g},${b})`);
    }
    this.palette = {};
    for (const name of ["ink", "soft", "line", "truth", "start", "paper", "s0", "s1", "s2", "s3", "s4", "s5"]) {
      this.palette[name] = cssColour(name);
    }
    this.redraw();
  }

  reset() {
    this.side = undefined;
    this.yaw = -0.5;
    this.pitch = 0.55;
    this.zoom = 1;
    this.target = [0, 0, 0];
    this.redraw();
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  // -- projection ----------------------------------------------------------------------------------------------------

  prepare() {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
    [this.width, this.height] = [width, height];
    this.focal = 1.15 * Math.min(height, width);
    this.distance = (2.7 * this.world.radius) / this.zoom;
    [this.cosYaw, this.sinYaw] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    [this.cosPitch, this.sinPitch] = [Math.cos(this.pitch), Math.sin(this.pitch)];
  }

  /** Screen position and depth of a point in scene coordinates relative to the centre of the world; null if behind. */
  project(x, y, z) {
    x -= this.target[0];
    y -= this.target[1];
    z -= this.target[2];
    const right = this.cosYaw * x - this.sinYaw * y;
    const away = this.sinYaw * x + this.cosYaw * y;
    const depth = this.distance + away * this.cosPitch - z * this.sinPitch;
    if (depth < 0.02 * this.distance) return null;
    const scale = this.focal / depth;
    return [this.width / 2 + right * scale, this.height / 2 - (away * this.sinPitch + z * this.cosPitch) * scale];
  }

  /** Screen position of element `k` of an array of world positions (or poses, with `step` 7). */
  at(array, k, step = 3) {
    const { basis: b, centre: c } = this.world;
    const x = array[step * k] - c[0], y = array[step * k + 1] - c[1], z = array[step * k + 2] - c[2];
    return this.project(b[0] * x + b[1] * y + b[2] * z, b[3] * x + b[4] * y + b[5] * z, b[6] * x + b[7] * y + b[8] * z);
  }

  // -- drawing -------------------------------------------------------------------------------------------------------

  draw() {
    if (!this.world || !this.canvas.clientWidth) return;
    this.prepare();
    const { world, layers, palette } = this;
    if (layers.grid) this.drawGrid();
    this.marks = []; // positions on the screen that an image should not cover, with their weights
    if (layers.map) this.drawPoints();
    if (layers.truth && world.truth.length) {
      this.drawLine(world.truth, 3, world.truthStarts, palette.truth, 3.5, 0.65);
    }
    for (const track of world.tracks) {
      this.drawLine(track.poses, 7, track.starts, palette["s" + track.colour], 1.8, 1);
    }
    if (layers.keyframes) this.drawDots(world.keyframes, palette.ink, 2);
    if (layers.loops) this.drawLoops();
    for (const track of world.tracks) this.drawDots(track.poses.subarray(0, 3), palette.start, 5);
    const corners = this.pose ? this.drawCamera(this.pose) : null;
    if (layers.image && this.picture && this.picture.complete && this.picture.naturalWidth) this.drawPicture(corners);
    this.drawAxes();
  }

  drawGrid() {
    const { step, cells, height, x, y } = this.world.grid;
    const context = this.context;
    context.strokeStyle = this.palette.line;
    context.lineWidth = 1;
    context.beginPath();
    const segment = (a, b) => {
      if (a && b) {
        context.moveTo(a[0], a[1]);
        context.lineTo(b[0], b[1]);
      }
    };
    for (let i = -cells; i <= cells; i++) {
      for (let k = -cells; k < cells; k++) { // in pieces, because a line may pass behind the camera
        segment(this.project(x + i * step, y + k * step, height), this.project(x + i * step, y + (k + 1) * step, height));
        segment(this.project(x + k * step, y + i * step, height), this.project(x + (k + 1) * step, y + i * step, height));
      }
    }
    context.stroke();
  }

  drawPoints() {
    const { points } = this.world;
    const few = points.length < 3 * 1500 ? 1.5 : 1;
    const size = few * Math.max(2, Math.min(4, 2 * Math.sqrt(this.zoom)));
    for (let k = 0; 3 * k < points.length; k++) {
      const p = this.at(points, k);
      if (!p || p[0] < 0 || p[1] < 0 || p[0] > this.width || p[1] > this.height) continue;
      this.marks.push([p[0], p[1], 1]);
      this.context.fillStyle = this.pointColours[k];
      this.context.fillRect(p[0] - size / 2, p[1] - size / 2, size, size);
    }
  }

  drawLine(array, step, starts, colour, width, alpha) {
    const context = this.context;
    const gaps = new Set(starts);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineJoin = "round";
    context.globalAlpha = alpha;
    context.beginPath();
    let down = false;
    const weight = (150 * step) / Math.max(array.length, 1); // a line counts as 150 points, however many it has
    for (let k = 0; step * k < array.length; k++) {
      const p = this.at(array, k, step);
      if (p) this.marks.push([p[0], p[1], weight]);
      if (p && down && !gaps.has(k)) context.lineTo(p[0], p[1]);
      else if (p) context.moveTo(p[0], p[1]);
      down = p !== null;
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  drawDots(array, colour, radius) {
    const context = this.context;
    context.fillStyle = colour;
    context.strokeStyle = this.palette.paper;
    context.lineWidth = 1;
    for (let k = 0; 3 * k < array.length; k++) {
      const p = this.at(array, k);
      if (!p) continue;
      context.beginPath();
      context.arc(p[0], p[1], radius, 0, 2 * Math.PI);
      context.fill();
      if (radius > 3) context.stroke();
    }
  }

  drawLoops() {
    const { loops } = this.world;
    const context = this.context;
    context.strokeStyle = this.palette.ink;
    context.lineWidth = 1.4;
    for (let k = 0; 6 * k < loops.length; k++) {
      const a = this.at(loops, 2 * k), b = this.at(loops, 2 * k + 1);
      if (!a || !b) continue;
      context.setLineDash([4, 3]);
      context.beginPath();
      context.moveTo(a[0], a[1]);
      context.lineTo(b[0], b[1]);
      context.stroke();
      context.setLineDash([]);
      for (const [x, y] of [a, b]) {
        context.beginPath();
        context.moveTo(x, y - 5);
        context.lineTo(x + 5, y);
        context.lineTo(x, y + 5);
        context.lineTo(x - 5, y);
        context.closePath();
        context.stroke();
      }
    }
  }

  /** Frustum of a camera: x right, y down, z along the optical axis; gives its corners on the screen, null if behind. */
  drawCamera(pose) {
    const size = 0.09 * this.world.radius / Math.sqrt(this.zoom);
    const [x, y, z, qx, qy, qz, qw] = pose;
    const corners = [[0, 0, 0], [-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1]].map((c) => {
      const v = c.map((value) => value * size);
      const t = [2 * (qy * v[2] - qz * v[1]), 2 * (qz * v[0] - qx * v[2]), 2 * (qx * v[1] - qy * v[0])];
      return this.at([
        x + v[0] + qw * t[0] + qy * t[2] - qz * t[1],
        y + v[1] + qw * t[1] + qz * t[0] - qx * t[2],
        z + v[2] + qw * t[2] + qx * t[1] - qy * t[0],
      ], 0);
    });
    if (corners.some((p) => !p)) return null;
    const context = this.context;
    context.strokeStyle = this.palette.ink;
    context.lineWidth = 1.6;
    context.beginPath();
    for (const k of [1, 2, 3, 4]) {
      context.moveTo(corners[0][0], corners[0][1]);
      context.lineTo(corners[k][0], corners[k][1]);
      context.lineTo(corners[(k % 4) + 1][0], corners[(k % 4) + 1][1]);
    }
    context.stroke();
    context.fillStyle = this.palette.ink;
    context.beginPath();
    context.arc(corners[0][0], corners[0][1], 3, 0, 2 * Math.PI);
    context.fill();
    return corners;
  }

  /** Image beside the frustum, where it covers least; of a frame without a pose in a corner of the view. */
  drawPicture(corners) {
    const context = this.context;
    const { naturalWidth, naturalHeight } = this.picture;
    const scale = Math.min(0.28 * this.width / naturalWidth, 0.34 * this.height / naturalHeight, 1.2);
    const [width, height] = [naturalWidth * scale, naturalHeight * scale];
    let [x, y] = [this.width - width - 10, 10];
    if (corners) {
      const [left, right] = [Math.min(...corners.map((p) => p[0])), Math.max(...corners.map((p) => p[0]))];
      const [top, bottom] = [Math.min(...corners.map((p) => p[1])), Math.max(...corners.map((p) => p[1]))];
      const [column, row] = [(left + right - width) / 2, (top + bottom - height) / 2];
      const places = [[right + 26, row], [left - 26 - width, row], [column, top - 44 - height], [column, bottom + 26]];
      const inside = places.map(([a, b]) => [
        Math.max(6, Math.min(this.width - width - 6, a)), Math.max(6, Math.min(this.height - height - 24, b)),
      ]);
      const costs = inside.map(([a, b]) => {
        const covers = ([u, v]) => u > a - 4 && u < a + width + 4 && v > b - 4 && v < b + height + 22;
        const frustum = corners.filter(covers).length;
        return this.marks.reduce((sum, mark) => sum + (covers(mark) ? mark[2] : 0), 1000 * frustum);
      });
      const best = costs.indexOf(Math.min(...costs));
      // While the frame moves, the image stays on its side unless another one is much better.
      if (this.side === undefined || costs[best] + 20 < 0.7 * costs[this.side]) this.side = best;
      [x, y] = inside[this.side];
      context.strokeStyle = this.palette.soft;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo((left + right) / 2, (top + bottom) / 2);
      const within = (low, value, high) => Math.max(low, Math.min(high, value));
      context.lineTo(within(x, (left + right) / 2, x + width), within(y, (top + bottom) / 2, y + height));
      context.stroke();
    }
    context.drawImage(this.picture, x, y, width, height);
    context.strokeStyle = this.palette.ink;
    context.lineWidth = 1.2;
    context.strokeRect(x, y, width, height);
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "top";
    const label = `image at ${this.pictureTime.toFixed(2)} s`;
    context.fillStyle = this.palette.paper;
    context.fillRect(x, y + height + 1, context.measureText(label).width + 8, 17);
    context.fillStyle = this.palette.ink;
    context.fillText(label, x + 4, y + height + 4);
  }

  /** Directions of the world's axes, and the size of a cell of the grid. */
  drawAxes() {
    const context = this.context;
    const b = this.world.basis;
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (let axis = 0; axis < 3; axis++) {
      const [x, y, z] = [b[axis], b[3 + axis], b[6 + axis]];
      const right = this.cosYaw * x - this.sinYaw * y;
      const up = (this.sinYaw * x + this.cosYaw * y) * this.sinPitch + z * this.cosPitch;
      const [from, to] = [[34, this.height - 36], [34 + 22 * right, this.height - 36 - 22 * up]];
      context.strokeStyle = context.fillStyle = this.palette.soft;
      context.lineWidth = 1.5;
      context.beginPath();
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
      context.stroke();
      context.fillText("xyz"[axis], 34 + 30 * right, this.height - 36 - 30 * up);
    }
    context.textAlign = "left";
    if (this.layers.grid) {
      const { step } = this.world.grid;
      context.fillText(`grid ${step}${this.world.unit === "m" ? " m" : ", unit free"}`, 74, this.height - 14);
    }
  }

  // -- input ---------------------------------------------------------------------------------------------------------

  turn(dx, dy) {
    this.yaw += dx;
    this.pitch = Math.max(-1.55, Math.min(1.55, this.pitch + dy));
    this.redraw();
  }

  /** Move the target by pixels of the screen. */
  move(dx, dy) {
    const [right, up] = [(-dx * this.distance) / this.focal, (dy * this.distance) / this.focal];
    this.target[0] += this.cosYaw * right + this.sinYaw * this.sinPitch * up;
    this.target[1] += -this.sinYaw * right + this.cosYaw * this.sinPitch * up;
    this.target[2] += this.cosPitch * up;
    this.redraw();
  }

  /** Zoom; what is at `x`, `y` (pixels from the middle of the canvas) stays there. */
  magnify(factor, x = 0, y = 0) {
    const before = this.zoom;
    this.zoom = Math.max(0.2, Math.min(60, before * factor));
    const change = this.zoom / before;
    this.distance /= change;
    this.move((1 - change) * x, (1 - change) * y);
  }

  listen() {
    const canvas = this.canvas;
    const fingers = new Map();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? spread() : 0;
      const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 2) {
        this.magnify(spread() / Math.max(before, 1));
        this.move(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 6) {
        this.move(dx, dy);
      } else {
        this.turn(0.008 * dx, 0.008 * dy);
      }
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => this.reset());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
      const factor = Math.exp(-0.0015 * Math.max(-300, Math.min(300, pixels)));
      this.magnify(factor, event.offsetX - this.width / 2, event.offsetY - this.height / 2);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (event.key in arrows) {
        const [x, y] = arrows[event.key];
        if (event.shiftKey) this.move(-30 * x, -30 * y);
        else this.turn(0.12 * x, -0.12 * y);
      } else if (event.key === "+" || event.key === "=") this.magnify(1.25);
      else if (event.key === "-") this.magnify(0.8);
      else if (event.key === "Home" || event.key === "0") this.reset();
      else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }
}
