// Shows a chart's values where it is pointed at, by mouse, touch or arrow keys, and where the 3-D view's slider is.
// A click or tap tells the slider, by the event `report-frame` of the document.
(() => {
  "use strict";

  const element = (parent, kind) => {
    const made = document.createElement("div");
    made.className = kind;
    made.hidden = true;
    parent.append(made);
    return made;
  };

  // Index of the number nearest to a value, in ascending numbers.
  const nearest = (numbers, value) => {
    let low = 0;
    let high = numbers.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (numbers[middle] <= value) low = middle;
      else high = middle;
    }
    return Math.abs(numbers[low] - value) <= Math.abs(numbers[high] - value) ? low : high;
  };

  const fill = (readout, title, lines) => {
    readout.replaceChildren();
    const head = document.createElement("b");
    head.textContent = title;
    readout.append(head);
    for (const [kind, text] of lines) {
      const line = document.createElement("div");
      if (kind) {
        const key = document.createElement("span");
        key.className = `key ${kind}`;
        line.append(key);
      }
      line.append(text);
      readout.append(line);
    }
  };

  // Puts the readout beside the place pointed at, and never over the plot's sides.
  const beside = (readout, plot, x) => {
    readout.hidden = false;
    const width = readout.offsetWidth;
    const right = x + 14 + width <= plot.clientWidth;
    const left = right ? x + 14 : x - 14 - width;
    readout.style.left = `${Math.max(Math.min(left, plot.clientWidth - width), 0)}px`;
  };

  class Chart {
    constructor(root) {
      this.plot = root.querySelector(".plot");
      this.data = JSON.parse(root.querySelector("script").textContent);
      this.readout = element(this.plot, "readout");
      this.readout.setAttribute("role", "status");
      this.row = 0;
      const plot = this.plot;
      const point = (event) => this.show(this.rowAt(event));
      plot.addEventListener("pointermove", point);
      plot.addEventListener("pointerdown", point);
      plot.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && this.hide());
      plot.addEventListener("blur", () => this.hide());
      plot.addEventListener("click", (event) => this.tell(this.rowAt(event)));
      plot.addEventListener("keydown", (event) => this.key(event));
    }

    key(event) {
      const last = this.data.frames.length - 1;
      const to = { ArrowLeft: this.row - 1, ArrowRight: this.row + 1, Home: 0, End: last }[event.key];
      if (event.key === "Escape") this.hide();
      if (event.key === "Enter") this.tell(this.row);
      if (to === undefined) return;
      event.preventDefault();
      this.show(Math.min(Math.max(to, 0), last));
    }

    tell(row) {
      const frame = this.data.frames[row];
      document.dispatchEvent(new CustomEvent("report-frame", { detail: { frame, from: "chart" } }));
    }
  }

  class LineChart extends Chart {
    constructor(root) {
      super(root);
      this.cursor = element(this.plot, "cursor");
      this.linked = element(this.plot, "cursor linked");
      this.spots = this.data.series.map((line) => element(this.plot, `spot key ${line.kind}`));
    }

    share(frame) {
      return frame / Math.max(this.data.count - 1, 1);
    }

    rowAt(event) {
      const box = this.plot.getBoundingClientRect();
      return nearest(this.data.frames, ((event.clientX - box.left) / box.width) * Math.max(this.data.count - 1, 1));
    }

    show(row) {
      this.row = row;
      const { frames, series, unit, low, high } = this.data;
      const x = this.share(frames[row]) * this.plot.clientWidth;
      this.cursor.hidden = false;
      this.cursor.style.left = `${x}px`;
      const lines = [];
      series.forEach((line, index) => {
        const value = line.values[row];
        const spot = this.spots[index];
        spot.hidden = value === null;
        spot.style.left = `${x}px`;
        spot.style.top = `${(100 * (high - value)) / (high - low || 1)}%`;
        if (value !== null) lines.push([line.kind, `${line.name} ${value} ${unit}`]);
      });
      fill(this.readout, `frame ${frames[row]}`, lines.length ? lines : [["", "no value"]]);
      beside(this.readout, this.plot, x);
    }

    hide() {
      for (const shown of [this.readout, this.cursor, ...this.spots]) shown.hidden = true;
    }

    link(frame) {
      this.linked.hidden = false;
      this.linked.style.left = `${100 * this.share(frame)}%`;
    }
  }

  class PlaneChart extends Chart {
    constructor(root) {
      super(root);
      this.svg = this.plot.querySelector("svg");
      this.spot = element(this.plot, "spot key estimate");
      this.linked = element(this.plot, "spot key mapping");
    }

    // From the SVG's units to px of the plot.
    place(row) {
      const [x, y] = [this.data.points[2 * row], this.data.points[2 * row + 1]];
      if (x === null) return null;
      const at = new DOMPoint(x, y).matrixTransform(this.svg.getScreenCTM());
      const box = this.plot.getBoundingClientRect();
      return [at.x - box.left, at.y - box.top];
    }

    rowAt(event) {
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
      const points = this.data.points;
      let best = 0;
      let least = Infinity;
      for (let row = 0; row < this.data.frames.length; row++) {
        if (points[2 * row] === null) continue;
        const distance = (points[2 * row] - at.x) ** 2 + (points[2 * row + 1] - at.y) ** 2;
        if (distance < least) [best, least] = [row, distance];
      }
      return best;
    }

    mark(spot, row) {
      const at = this.place(row);
      spot.hidden = at === null;
      if (at) [spot.style.left, spot.style.top] = at.map((value) => `${value}px`);
      return at;
    }

    show(row) {
      this.row = row;
      const at = this.mark(this.spot, row);
      const [right, forward] = [this.data.meters[2 * row], this.data.meters[2 * row + 1]];
      const text = at ? `${right} m right, ${forward} m forward` : "lost";
      fill(this.readout, `frame ${this.data.frames[row]}`, [["", text]]);
      beside(this.readout, this.plot, at ? at[0] : 0);
      const covers = at && at[1] < this.readout.offsetHeight + 16;
      this.readout.style.top = covers ? "auto" : "4px";
      this.readout.style.bottom = covers ? "4px" : "auto";
    }

    hide() {
      this.readout.hidden = this.spot.hidden = true;
    }

    link(frame) {
      this.mark(this.linked, nearest(this.data.frames, frame));
    }
  }

  const charts = [
    ...[...document.querySelectorAll(".line-chart")].map((root) => new LineChart(root)),
    ...[...document.querySelectorAll(".plane-chart")].map((root) => new PlaneChart(root)),
  ];
  document.addEventListener("report-frame", (event) => {
    for (const chart of charts) chart.link(event.detail.frame);
  });
  // A tap elsewhere ends what a tap on a chart began; touch has no `pointerleave` that would.
  document.addEventListener("pointerdown", (event) => {
    for (const chart of charts) if (!chart.plot.contains(event.target)) chart.hide();
  });
})();
