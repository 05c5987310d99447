"use strict";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 44, right: 8 };

/** New SVG element in a parent. */
function draw(parent, name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  parent.append(element);
  return element;
}

/** Step of 1, 2 or 5 times a power of ten that divides a span into at most `count` parts. */
function niceStep(span, count) {
  const raw = Math.max(span, 1e-12) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= raw * 0.999);
}

/** Number with as many decimals as its step needs. */
function withStep(value, step) {
  return value.toFixed(Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9))));
}

/** Seconds, in a unit that fits. */
function duration(seconds) {
  return seconds < 1 ? `${Math.round(1000 * seconds)} ms` : `${seconds.toFixed(2)} s`;
}

/** Charts that share an axis of time, and a cursor. */
class Charts {
  constructor(host, data, onPick) {
    [this.host, this.data, this.onPick] = [host, data, onPick];
    this.lines = [];
    const { time } = data.frames;
    this.last = Math.max(time[time.length - 1] || 0, 1e-9);
    new ResizeObserver(() => {
      if (host.clientWidth !== this.width) this.redraw();
    }).observe(host);
    this.redraw();
  }

  x(seconds) {
    return MARGIN.left + (seconds / this.last) * (this.width - MARGIN.left - MARGIN.right);
  }

  redraw() {
    this.width = this.host.clientWidth;
    this.host.textContent = "";
    this.lines = [];
    if (this.width < 100) return;
    this.timeline();
    const { frames } = this.data;
    const per = frames.every > 1 ? `, largest of every ${frames.every} frames` : "";
    if (frames.error.some(Number.isFinite)) this.curve(`Error of the position after Sim(3) alignment, m${per}`, frames.error);
    if (frames.seconds.some(Number.isFinite)) this.curve(`Time of a frame, s${per}`, frames.seconds);
    this.place(this.now);
  }

  figure(caption, height) {
    const figure = document.createElement("figure");
    const title = document.createElement("figcaption");
    title.textContent = caption;
    figure.append(title);
    this.host.append(figure);
    const svg = draw(figure, "svg", { viewBox: `0 0 ${this.width} ${height}`, height, role: "img", "aria-label": caption });
    const pick = (event) => {
      if (event.pointerType === "mouse" && event.type === "pointermove" && !event.buttons) return;
      const seconds = (event.clientX - svg.getBoundingClientRect().left - MARGIN.left) /
        (this.width - MARGIN.left - MARGIN.right) * this.last;
      this.onPick(Math.max(0, Math.min(this.last, seconds)));
    };
    svg.addEventListener("pointerdown", pick);
    svg.addEventListener("pointermove", pick);
    return svg;
  }

  cursorLine(svg, height) {
    this.lines.push(draw(svg, "line", { class: "now", y1: 0, y2: height }));
  }

  timeAxis(svg, y) {
    const step = niceStep(this.last, Math.max(3, Math.floor(this.width / 110)));
    for (let t = 0; t <= this.last * 1.0001; t += step) {
      const end = t + step > this.last * 1.0001;
      const anchor = end && this.x(t) > this.width - 30 ? "end" : "middle";
      draw(svg, "text", { x: this.x(t), y, "text-anchor": anchor }, withStep(t, step) + (end ? " s" : ""));
    }
  }

  /** State of the tracker, segments, keyframes and loops over time. */
  timeline() {
    const { data } = this;
    const loops = data.loops.length ? 30 : 0;
    const keys = data.keyframes.length ? 14 : 0;
    const height = loops + 24 + 18 + keys + 22;
    const svg = this.figure("State of the tracker, segments" + (keys ? ", keyframes" : "") + (loops ? ", loops" : ""), height);
    for (const [from, to] of data.loops) {
      const [a, b] = [this.x(to), this.x(from)];
      const path = `M${a} ${loops} Q${(a + b) / 2} ${-loops * 0.8} ${b} ${loops}`;
      const arc = draw(svg, "path", { class: "curve", d: path, style: "stroke: var(--ink)" });
      draw(arc, "title", {}, `loop: ${from.toFixed(2)} s sees the place of ${to.toFixed(2)} s`);
    }
    const bar = (from, to, y, h, colour, label, title) => {
      const width = Math.max(this.x(to) - this.x(from), 1);
      const box = draw(svg, "rect", { x: this.x(from), y, width, height: h, style: `fill: var(--${colour})` });
      draw(box, "title", {}, title);
      if (width > 7 * label.length + 8) {
        draw(svg, "text", { class: "on", x: this.x(from) + width / 2, y: y + h / 2 + 4, "text-anchor": "middle" }, label);
      }
    };
    for (const [from, to, status, reason, count] of data.states) {
      const frames = `${count} frame${count === 1 ? "" : "s"}`;
      const label = reason ? `${status}: ${reason}` : status;
      bar(from, to, loops, 24, status, label, `${label}, ${frames}, ${from.toFixed(2)} to ${to.toFixed(2)} s`);
    }
    for (const [from, to, segment, colour] of data.ribbons) {
      bar(from, to, loops + 27, 14, `s${colour}`, `segment ${segment}`, `segment ${segment}`);
    }
    const top = loops + 44;
    let ticks = "";
    for (const t of data.keyframes) ticks += `M${this.x(t).toFixed(1)} ${top}v9`;
    if (keys) draw(svg, "path", { class: "curve", d: ticks, style: "stroke: var(--soft); stroke-width: 1" });
    this.timeAxis(svg, height - 6);
    this.cursorLine(svg, height - 18);
  }

  /** Curve of a value of each frame, in the colours of the segments. */
  curve(caption, values) {
    const { time, segment, colour } = this.data.frames;
    const known = [...values].filter(Number.isFinite).sort((a, b) => a - b);
    const peak = known[known.length - 1];
    const usual = known[Math.floor(0.98 * (known.length - 1))];
    const cut = peak > 4 * usual && usual > 0;
    const top = cut ? 1.5 * usual : Math.max(peak, 1e-9) * 1.05;
    const height = 118, bottom = height - 20;
    const svg = this.figure(caption + (cut ? ` (cut off; the highest value is ${peak.toPrecision(3)})` : ""), height);
    const y = (value) => bottom - (Math.min(value, top) / top) * (bottom - 6);
    const step = niceStep(top, 3);
    for (let v = 0; v <= top; v += step) {
      draw(svg, "line", { class: "axis", x1: MARGIN.left, x2: this.width - MARGIN.right, y1: y(v), y2: y(v) });
      draw(svg, "text", { x: MARGIN.left - 6, y: y(v) + 4, "text-anchor": "end" }, withStep(v, step));
    }
    const parts = new Map();
    let before = null;
    for (let k = 0; k < values.length; k++) {
      if (!Number.isFinite(values[k])) {
        if (this.data.frames.fed[k]) before = null; // a skipped frame does not end the line
        continue;
      }
      const joined = before !== null && segment[before] === segment[k];
      const point = `${joined ? "L" : "M"}${this.x(time[k]).toFixed(1)} ${y(values[k]).toFixed(1)}${joined ? "" : "h.1"}`;
      parts.set(colour[k], (parts.get(colour[k]) || "") + point);
      before = k;
    }
    for (const [number, path] of parts) {
      const stroke = number < 0 ? "var(--soft)" : `var(--s${number})`;
      draw(svg, "path", { class: "curve", d: path, style: `stroke: ${stroke}` });
    }
    this.timeAxis(svg, height - 5);
    this.cursorLine(svg, bottom);
  }

  /** Move the cursor to a time, seconds. */
  place(seconds) {
    this.now = seconds || 0;
    for (const line of this.lines) {
      line.setAttribute("x1", this.x(this.now));
      line.setAttribute("x2", this.x(this.now));
    }
  }
}
