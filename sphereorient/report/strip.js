// The strip of every frame's quality: draws it, and shows the chosen frame. Each section.strip of the page is independent
// and contains its data as JSON, made by frame_warnings.py. A bin is one frame, or `per_bin` of a long track.
(() => {
  "use strict";
  const DETAIL = { least: 40, most: 200, share: 1 / 5 }; // bins shown large: a share of all, within limits
  const ROW = { status: 20, camera: 36, error: 60, pictures: 18, axis: 40, gap: 4 }; // heights, CSS px
  const FONT = "15px system-ui, sans-serif";

  const clamp = (value, low, high) => Math.max(low, Math.min(high, value));
  const known = (values) => values.filter((value) => value !== null);
  const short = (value, unit) => (value === null ? "unknown" : `${Number(value.toPrecision(3))}${unit}`);

  /** The smallest of 1, 2, 5, 10, 20 ... that is not below a value. */
  function niceStep(least) {
    const power = 10 ** Math.floor(Math.log10(Math.max(least, 1)));
    return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least);
  }

  /** 1, 2, 5 of every power of ten between two values, and the ones just outside. */
  function logTicks(low, high) {
    const ticks = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++)
      for (const factor of [1, 2, 5]) ticks.push(Number((factor * 10 ** power).toPrecision(1)));
    const first = ticks.findLastIndex((tick) => tick <= low);
    const last = ticks.findIndex((tick) => tick >= high);
    return ticks.slice(Math.max(first, 0), (last < 0 ? ticks.length : Math.max(last, first + 1)) + 1);
  }

  /** One canvas with rows for status, cameras, stated error, and the axis. */
  class Plot {
    constructor(owner, canvas) {
      Object.assign(this, { owner, canvas, first: 0, last: owner.bins });
      const rows = [{ kind: "status", label: "frames" }];
      rows.push(...owner.strip.cameras.map((camera) => ({ kind: "camera", label: camera.name, camera })));
      rows.push({ kind: "error", label: "error (°)" });
      if (owner.figures.length) rows.push({ kind: "pictures", label: "pictures" });
      this.rows = rows;
      this.height = rows.reduce((sum, row) => sum + ROW[row.kind] + ROW.gap, ROW.axis + ROW.gap);
    }

    /** Fit the canvas to its place on the page and to the screen's pixels, and draw. */
    draw() {
      const scale = window.devicePixelRatio || 1;
      this.canvas.style.height = `${this.height}px`;
      this.width = this.canvas.clientWidth;
      this.canvas.width = Math.round(this.width * scale);
      this.canvas.height = Math.round(this.height * scale);
      this.ink = this.canvas.getContext("2d");
      this.ink.setTransform(scale, 0, 0, scale, 0, 0);
      this.ink.font = FONT;
      this.ink.textBaseline = "middle";
      this.left = this.width < 600 ? 88 : 112;
      this.right = this.width - 10;
      this.drawRows();
      this.drawAxis();
      this.drawCursor();
    }

    binAt(x) {
      const share = (x - this.left) / (this.right - this.left);
      return clamp(Math.floor(this.first + share * (this.last - this.first)), this.first, this.last - 1);
    }

    xOf(bin) {
      return this.left + ((bin - this.first) / (this.last - this.first)) * (this.right - this.left);
    }

    /** Call draw(x, width, from, to) for every bin, or for every pixel where there are more bins than pixels. */
    cells(draw) {
      const count = Math.min(this.last - this.first, Math.floor(this.right - this.left));
      for (let cell = 0; cell < count; cell++) {
        const from = this.first + Math.floor((cell * (this.last - this.first)) / count);
        const to = this.first + Math.floor(((cell + 1) * (this.last - this.first)) / count);
        const width = (this.right - this.left) / count;
        const gap = this === this.owner.detail && width > 4 ? 1 : 0; // separate single frames if large
        const [x, end] = [this.left + cell * width, this.left + (cell + 1) * width];
        const right = gap ? Math.floor(end) - gap : Math.ceil(end);
        draw(Math.floor(x), right - Math.floor(x), from, Math.max(to, from + 1));
      }
    }

    drawRows() {
      let top = ROW.gap;
      for (const row of this.rows) {
        const height = ROW[row.kind];
        Object.assign(row, { top, height });
        this.drawLabel(row);
        this[`${row.kind}Row`](row);
        top += height + ROW.gap;
      }
      this.axisTop = top;
    }

    drawLabel({ label, top, height, kind }) {
      const room = this.left - (kind === "camera" || kind === "error" ? 36 : 10);
      let text = label;
      while (text.length > 1 && this.ink.measureText(text).width > room) text = `${text.slice(0, -2)}…`;
      this.write(text, 2, top + height / 2, "left", "ink");
    }

    write(text, x, y, align, colour = "faint") {
      this.ink.fillStyle = this.owner.colours[colour];
      this.ink.textAlign = align;
      this.ink.fillText(text, x, y);
    }

    statusRow({ top, height }) {
      const { status } = this.owner.strip;
      this.cells((x, width, from, to) => {
        this.ink.fillStyle = this.owner.colours[Math.max(...status.slice(from, to))];
        this.ink.fillRect(x, top, width, height);
      });
    }

    /** Where the camera measured nothing the row is dark; the line is its score. */
    cameraRow({ camera, top, height }) {
      const { status } = this.owner.strip;
      this.cells((x, width, from, to) => {
        const noBall = status.slice(from, to).every((one) => one === 1);
        const lost = camera.reason.slice(from, to).some((code) => code);
        this.ink.fillStyle = this.owner.colours[noBall ? 1 : lost ? 3 : 0];
        this.ink.fillRect(x, top, width, height);
      });
      const low = this.owner.lowScore;
      const place = (score) => top + 2 + clamp(1 - (score - low) / (1 - low), 0, 1) * (height - 4);
      this.steps(camera.score, place, (values) => Math.min(...values));
      this.write("1", this.left - 5, top + 8, "right");
      this.write(String(low), this.left - 5, top + height - 7, "right");
    }

    /** The stated error of the orientation, logarithmic. */
    errorRow({ top, height }) {
      const ticks = this.owner.errorTicks;
      if (!ticks.length) return this.write("no stated errors", this.left + 4, top + height / 2, "left");
      const [low, high] = [Math.log(ticks[0]), Math.log(ticks[ticks.length - 1])];
      const place = (value) => top + 9 + (1 - (Math.log(value) - low) / (high - low)) * (height - 18);
      const every = Math.ceil(ticks.length / 3);
      ticks.forEach((tick, k) => {
        if (k % every) return;
        this.ink.fillStyle = this.owner.colours.line;
        this.ink.fillRect(this.left, place(tick) - 0.5, this.right - this.left, 1);
        this.write(String(tick), this.left - 5, place(tick), "right");
      });
      this.steps(this.owner.strip.orientation_error_deg, place, (values) => Math.max(...values));
    }

    /** Draw values as a line of steps, interrupted where there are none. */
    steps(values, place, worst) {
      const { ink } = this;
      ink.beginPath();
      let pen = false;
      this.cells((x, width, from, to) => {
        const there = known(values.slice(from, to));
        if (there.length) {
          const y = place(worst(there));
          if (pen) ink.lineTo(x, y);
          else ink.moveTo(x, y);
          ink.lineTo(x + width, y);
        }
        pen = there.length > 0;
      });
      for (const [colour, width] of [["paper", 3], ["ink", 1.3]]) {
        ink.strokeStyle = this.owner.colours[colour];
        ink.lineWidth = width;
        ink.stroke();
      }
    }

    /** A mark for every picture; those that are only there to compare with are short. */
    picturesRow({ top, height }) {
      for (const { bin, plain } of this.owner.figures) {
        if (bin < this.first || bin >= this.last) continue;
        this.ink.fillStyle = this.owner.colours[plain ? "faint" : "ink"];
        this.ink.fillRect(this.xOf(bin + 0.5) - 1, plain ? top + height / 2 : top, 2, plain ? height / 2 : height);
      }
    }

    /** Frame numbers, and below them their times. */
    drawAxis() {
      const { strip, bins } = this.owner;
      const { row, number } = strip;
      const room = 100 / Math.max(this.right - this.left, 1);
      const step = niceStep((this.last - this.first) * strip.per_bin * room);
      const start = number[0] - row[0];
      const gapless = number[bins - 1] - row[bins - 1] === start;
      const ends = [this.first, this.last].map((bin) => bin * strip.per_bin + (gapless ? start : 0));
      for (let at = Math.ceil(ends[0] / step) * step; at < ends[1]; at += step) {
        const bin = (at - (gapless ? start : 0)) / strip.per_bin;
        const nearest = clamp(Math.floor(bin), 0, bins - 1);
        const x = this.xOf(strip.per_bin > 1 ? bin : bin + 0.5);
        this.ink.fillStyle = this.owner.colours.faint;
        this.ink.fillRect(x - 0.5, this.axisTop, 1, 4);
        const align = x > this.right - 24 ? "right" : x < this.left + 24 ? "left" : "center";
        const label = gapless ? at : number[nearest];
        this.write(String(label), x, this.axisTop + 11, align, "ink");
        this.write(this.owner.time(nearest, label - number[nearest]), x, this.axisTop + 29, align);
      }
      this.write("frame", 2, this.axisTop + 11, "left", "ink");
      this.write("time (s)", 2, this.axisTop + 29, "left");
    }

    drawCursor() {
      const { ink, owner } = this;
      const bottom = this.axisTop - 1;
      if (this.box) {
        const x = this.xOf(this.box.first);
        const width = Math.max(this.xOf(this.box.last) - x, 5); // visible in long tracks
        ink.strokeStyle = owner.colours.ink;
        ink.lineWidth = 1.5;
        ink.strokeRect(x, 2, width, bottom - 2);
      }
      const x = this.xOf(owner.bin + 0.5);
      for (const [colour, width] of [["paper", 4], ["ink", 1.6]]) {
        ink.fillStyle = owner.colours[colour];
        ink.fillRect(x - width / 2, 0, width, bottom);
      }
    }
  }

  class Strip {
    constructor(section) {
      this.section = section;
      this.strip = JSON.parse(this.find("script[type='application/json']").textContent);
      this.bins = this.strip.row.length;
      section.classList.add("strip--live");
      section.querySelectorAll(".strip__live").forEach((part) => (part.hidden = false));
      if (!this.bins) return;
      this.readStyle();
      this.readScales();
      this.readPictures();
      this.stretches = [...section.querySelectorAll("[data-first]")].map((part) => ({
        part, first: Number(part.dataset.first), last: Number(part.dataset.last),
      }));
      this.overview = new Plot(this, this.find(".strip__overview"));
      this.detail = new Plot(this, this.find(".strip__detail"));
      this.overview.box = this.detail;
      this.listen();
      this.bin = 0;
      if (this.stretches.length) this.jump(this.stretches[0]); // the worst frame
      else this.choose(0, true);
      new ResizeObserver(() => this.draw()).observe(this.find(".strip__plots"));
      window.addEventListener("resize", () => this.draw());
    }

    find(selector) {
      return this.section.querySelector(selector);
    }

    readStyle() {
      const style = getComputedStyle(this.section);
      this.colours = {};
      for (const name of [0, 1, 2, 3, "ink", "faint", "line", "paper"])
        this.colours[name] = style.getPropertyValue(`--strip-${name}`).trim();
    }

    /** What is the same in both plots: the scales of scores and errors, and the digits of times. */
    readScales() {
      const { strip } = this;
      const scores = known(strip.cameras.flatMap((camera) => camera.score));
      const lowest = scores.reduce((low, score) => Math.min(low, score), 0.55);
      this.lowScore = clamp(Math.floor(lowest * 10) / 10, 0, 0.5);
      const errors = known(strip.orientation_error_deg).filter((value) => value > 0);
      const [low, high] = errors.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, 0]);
      this.errorTicks = errors.length ? logTicks(low, high) : [];
      const times = known(strip.time_s);
      const step = (times[times.length - 1] - times[0]) / Math.max(strip.row[this.bins - 1] - strip.row[0], 1);
      this.frameTime = step > 0 ? step : 0;
      this.timeDigits = step > 0 ? clamp(Math.ceil(-Math.log10(step)) + 1, 0, 9) : 3;
    }

    /** Take the pictures, which without a script are spread over the page, and know them by their bins. */
    readPictures() {
      this.figures = [...this.section.querySelectorAll(".strip__picture")].map((figure) => ({
        figure,
        row: Number(figure.dataset.row),
        number: figure.dataset.number,
        good: figure.dataset.status === "0",
        plain: "plain" in figure.dataset,
        bin: Math.floor(Number(figure.dataset.row) / this.strip.per_bin),
      }));
      this.figures.sort((a, b) => a.row - b.row);
      for (const { figure, bin } of this.figures) figure.addEventListener("click", () => this.choose(bin, true));
      this.find(".strip__folded")?.remove();
    }

    listen() {
      for (const plot of [this.overview, this.detail]) {
        const { canvas } = plot;
        const follow = (event) => this.choose(plot.binAt(event.offsetX), plot === this.overview);
        canvas.addEventListener("pointerdown", (event) => {
          canvas.setPointerCapture(event.pointerId);
          follow(event);
        });
        canvas.addEventListener("pointermove", (event) => {
          if (event.buttons) follow(event);
          this.showTip(plot, event);
        });
        canvas.addEventListener("pointerleave", () => (this.find(".strip__tip").hidden = true));
      }
      this.section.addEventListener("keydown", (event) => this.onKey(event));
      for (const stretch of this.stretches) stretch.part.addEventListener("click", () => this.jump(stretch));
      for (const button of this.section.querySelectorAll("[data-step]"))
        button.addEventListener("click", () => this.choose(this.bin + Number(button.dataset.step)));
      this.find(".strip__number").addEventListener("change", (event) => this.goTo(Number(event.target.value)));
    }

    onKey(event) {
      if (event.target.tagName === "INPUT" || event.ctrlKey || event.altKey || event.metaKey) return;
      const many = event.shiftKey ? 10 : 1;
      const moves = { ArrowLeft: -many, ArrowRight: many };
      if (event.target.tagName === "CANVAS")
        Object.assign(moves, { PageUp: -10, PageDown: 10, Home: -this.bins, End: this.bins });
      if (!(event.key in moves)) return;
      event.preventDefault();
      this.choose(this.bin + moves[event.key]);
    }

    /** Go to a frame of a stretch, one with a picture where there is any. */
    jump({ first, last }) {
      const middle = (first + last) / 2;
      const inside = this.figures.filter(({ row, good }) => row >= first && row <= last && !good);
      inside.sort((a, b) => Math.abs(a.row - middle) - Math.abs(b.row - middle));
      this.choose(inside.length ? inside[0].bin : Math.floor(first / this.strip.per_bin), true);
    }

    /** Go to the frame of a number, or the nearest there is. */
    goTo(number) {
      const distance = (bin) => Math.abs(this.strip.number[bin] - number);
      let best = 0;
      for (let bin = 1; bin < this.bins; bin++) if (distance(bin) < distance(best)) best = bin;
      this.choose(best, true);
    }

    /** Look at a bin; the detail is moved where it must be, or centred. */
    choose(bin, centred = false) {
      this.bin = clamp(bin, 0, this.bins - 1);
      const { detail } = this;
      const size = Math.min(Math.round(clamp(this.bins * DETAIL.share, DETAIL.least, DETAIL.most)), this.bins);
      this.find(".strip__whole").hidden = size === this.bins; // it would be the same
      const margin = Math.min(8, Math.floor(size / 4));
      let first = clamp(detail.first, this.bin - size + 1 + margin, this.bin - margin);
      if (centred) first = this.bin - Math.floor(size / 2);
      detail.first = clamp(first, 0, this.bins - size);
      detail.last = detail.first + size;
      this.showReadout();
      this.showPictures();
      this.draw();
    }

    draw() {
      this.overview.draw();
      this.detail.draw();
    }

    /** The time of a bin, or of so many frames later, in words. */
    time(bin, later = 0) {
      const time = this.strip.time_s[bin];
      return time === null ? "unknown" : (time + later * this.frameTime).toFixed(this.timeDigits);
    }

    title(bin) {
      const { strip } = this;
      const which = `frame ${strip.number[bin]}, ${this.time(bin)} s: ${strip.status_words[strip.status[bin]]}`;
      const count = Math.min(strip.per_bin, strip.frames - bin * strip.per_bin);
      return strip.per_bin > 1 ? `the worst of ${count} frames is ${which}` : which;
    }

    /** What is known of a bin, as pairs of label and words. */
    facts(bin) {
      const { strip } = this;
      const flags = strip.flag_words.filter(([bit]) => strip.flags[bin] & bit).map(([, words]) => words);
      const facts = [["flags", flags.join("; ") || "none"]];
      for (const camera of strip.cameras) {
        const score = camera.score[bin] === null ? "no score" : `score ${camera.score[bin].toFixed(3)}`;
        facts.push([camera.name, `${strip.reason_words[camera.reason[bin]]}, ${score}`]);
      }
      const [turn, shift] = [short(strip.orientation_error_deg[bin], "°"), short(strip.position_error[bin], ` ${strip.length_unit}`)];
      facts.push(["stated error", `orientation ${turn}, position ${shift}`]);
      if (strip.apart_deg) facts.push(["cameras apart", short(strip.apart_deg[bin], "°")]);
      return facts;
    }

    showReadout() {
      const { strip, bin } = this;
      const readout = this.find(".strip__readout");
      const title = document.createElement("b");
      title.textContent = this.title(bin);
      const list = document.createElement("dl");
      for (const pair of this.facts(bin))
        pair.forEach((text, k) => list.append(Object.assign(document.createElement(k ? "dd" : "dt"), { textContent: text })));
      readout.replaceChildren(title, list);
      readout.style.borderLeftColor = this.colours[strip.status[bin]];
      this.find(".strip__number").value = strip.number[bin];
      const row = strip.row[bin];
      for (const { part, first, last } of this.stretches) part.classList.toggle("strip__here", row >= first && row <= last);
      for (const { canvas } of [this.overview, this.detail]) {
        const said = { valuemin: strip.number[0], valuemax: strip.number[this.bins - 1], valuenow: strip.number[bin] };
        for (const [name, value] of Object.entries(said)) canvas.setAttribute(`aria-${name}`, value);
        canvas.setAttribute("aria-valuetext", this.title(bin));
      }
    }

    showTip(plot, event) {
      const tip = this.find(".strip__tip");
      const bin = plot.binAt(event.offsetX);
      tip.textContent = [this.title(bin), ...this.facts(bin).map((pair) => pair.join(": "))].join("\n");
      tip.hidden = false;
      const x = plot.canvas.offsetLeft + event.offsetX;
      const space = plot.canvas.clientWidth - tip.offsetWidth;
      tip.style.left = `${clamp(x + 14 > space ? x - tip.offsetWidth - 14 : x + 14, 0, Math.max(space, 0))}px`;
      tip.style.top = `${plot.canvas.offsetTop + event.offsetY + 16}px`;
    }

    /** Show the nearest picture, and beside it a good one to compare with and those before and after. */
    showPictures() {
      if (!this.figures.length) return;
      const row = this.strip.row[this.bin];
      const far = ({ row: other, bin }) => (bin === this.bin ? 0 : Math.abs(other - row));
      const nearest = (some) => some.reduce((best, one) => (!best || far(one) < far(best) ? one : best), undefined);
      const main = nearest(this.figures);
      const here = main.bin === this.bin;
      const shown = new Map([[main, here ? "the chosen frame" : "the nearest picture"]]);
      const add = (role, fits) => {
        const one = nearest(this.figures.filter((other) => other !== main && fits(other)));
        if (one && !shown.has(one)) shown.set(one, role);
      };
      add("nearest good frame, to compare with", (other) => other.good);
      add("picture before", (other) => other.row < main.row);
      add("picture after", (other) => other.row > main.row);
      for (const [one, role] of shown) one.figure.querySelector(".strip__role").textContent = role;
      const [first, ...others] = [...shown.keys()].map(({ figure }) => figure);
      this.find(".strip__main").replaceChildren(first);
      this.find(".strip__pictures").replaceChildren(...others);
      const missing = `No picture of frame ${this.strip.number[this.bin]} embedded; nearest is frame ${main.number}.`;
      this.find(".strip__nearest").textContent = here ? `Picture of frame ${main.number}:` : missing;
    }
  }

  const start = () => document.querySelectorAll("section.strip").forEach((section) => new Strip(section));
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", start);
  else start();
})();
