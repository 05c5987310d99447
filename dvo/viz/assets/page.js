"use strict";

(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { frames } = data;
  for (const name of ["time", "seconds", "error", "segment", "colour", "fed"]) frames[name] = decode(frames[name]);
  data.keyframes = decode(data.keyframes);
  for (const world of data.worlds) {
    for (const name of ["truth", "points", "keyframes", "loops"]) world[name] = decode(world[name]);
    world.colors = decode(world.colors, Uint8Array);
    for (const track of world.tracks) [track.time, track.poses] = [decode(track.time), decode(track.poses)];
  }
  for (const entry of data.images) {
    const picture = new Image();
    picture.addEventListener("load", () => view.redraw());
    picture.src = `data:image/jpeg;base64,${entry[1]}`;
    entry[1] = picture;
  }
  const imageTimes = data.images.map(([time]) => time);
  const find = (id) => document.getElementById(id);
  const view = new OrbitView(find("view"));
  const [cursor, readout, play, chooser] = [find("cursor"), find("readout"), find("play"), find("world")];
  cursor.max = Math.max(frames.time.length - 1, 0);
  let world = data.worlds[0];

  /** Index of the last time that is not later; times increase. */
  function before(times, seconds) {
    let [low, high] = [0, times.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= seconds) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  function useWorld(number) {
    world = data.worlds[number];
    chooser.value = number;
    const { layers } = view;
    const offered = [
      ["map", "map", world.points.length], ["truth", "ground truth", world.truth.length],
      ["keyframes", "keyframes", world.keyframes.length], ["loops", "loops", world.loops.length],
      ["image", "image of the frame", imageTimes.length], ["grid", "grid", 1],
    ];
    find("layers").textContent = "";
    for (const [name, text, count] of offered) {
      if (!count) continue;
      const label = document.createElement("label");
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = layers[name];
      box.addEventListener("change", () => {
        layers[name] = box.checked;
        view.redraw();
      });
      label.append(box, text);
      find("layers").append(label);
    }
    view.show(world);
  }

  function moveTo(index, follow = true) {
    cursor.value = index;
    const t = frames.time[index] || 0;
    const state = data.states.find(([from, to]) => t >= from && t < to) || data.states[data.states.length - 1];
    const parts = [`${t.toFixed(2)} s`];
    if (state) parts.push(state[3] ? `${state[2]}: ${state[3]}` : state[2]);
    if (frames.segment[index] >= 0) parts.push(`segment ${frames.segment[index]}`);
    if (Number.isFinite(frames.seconds[index])) parts.push(duration(frames.seconds[index]));
    if (Number.isFinite(frames.error[index])) parts.push(`error ${frames.error[index].toPrecision(3)} m`);
    readout.textContent = parts.join(" · ");
    view.pose = view.picture = null;
    if (imageTimes.length) {
      const last = before(imageTimes, t);
      const next = Math.min(last + 1, imageTimes.length - 1);
      [view.pictureTime, view.picture] = data.images[imageTimes[next] - t < t - imageTimes[last] ? next : last];
    }
    if (frames.segment[index] >= 0) {
      const has = (candidate) => candidate.tracks.find((track) => track.segment === frames.segment[index]);
      if (follow && !has(world) && data.worlds.some(has)) useWorld(data.worlds.findIndex(has));
      const track = has(world);
      if (track) {
        const row = before(track.time, t + 1e-4);
        view.pose = track.poses.subarray(7 * row, 7 * row + 7);
      }
    }
    charts.place(t);
    view.redraw();
  }

  const charts = new Charts(find("charts"), data, (seconds) => moveTo(before(frames.time, seconds)));
  data.worlds.forEach((candidate, number) => chooser.add(new Option(candidate.name, number)));
  find("worlds").hidden = data.worlds.length < 2;
  chooser.addEventListener("change", () => {
    useWorld(Number(chooser.value));
    moveTo(Number(cursor.value), false);
    view.reset();
  });
  find("reset").addEventListener("click", () => view.reset());
  cursor.addEventListener("input", () => moveTo(Number(cursor.value)));

  let playing = null; // clock time of the start of the sequence
  function step(now) {
    if (playing === null) return;
    const t = (now - playing) / 1000;
    moveTo(before(frames.time, t));
    if (t >= frames.time[frames.time.length - 1]) toggle();
    else requestAnimationFrame(step);
  }
  function toggle() {
    const index = Number(cursor.value);
    const from = index >= frames.time.length - 1 ? 0 : frames.time[index];
    playing = playing === null ? performance.now() - 1000 * from : null;
    play.textContent = playing === null ? "\u25b6" : "\u275a\u275a";
    play.setAttribute("aria-label", playing === null ? "Play" : "Pause");
    if (playing !== null) requestAnimationFrame(step);
  }
  play.addEventListener("click", toggle);

  const statuses = [...new Set(data.states.map((state) => state[2]))];
  for (const status of statuses) {
    const swatch = document.createElement("span");
    swatch.style.background = `var(--${status})`;
    find("key").append(swatch, status);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => view.show(world));
  useWorld(0);
  view.reset();
  moveTo(0);
})();
