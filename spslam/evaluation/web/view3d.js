// The 3-D view: loads what the page holds, and connects it with mouse, touch, switches and slider.
(() => {
  "use strict";

  const FIELD_OF_VIEW = 45;
  const ELEVATION = (40 * Math.PI) / 180;
  // A longer recording is played faster, in this many seconds.
  const LONGEST_PLAY_S = 40;

  const root = document.getElementById("view3d");
  if (!root) return;
  const find = (selector) => root.querySelector(selector);

  const explain = (reason) => {
    root.classList.remove("works");
    find(".live").hidden = true;
    const note = find(".without");
    note.hidden = false;
    const instead = find(".still img") ? ": a still picture in its place." : ".";
    note.textContent = `The 3-D view can't be shown, because ${reason}${instead}`;
  };

  const missing = () => {
    if (typeof DecompressionStream === "undefined") return "this browser has no DecompressionStream";
    if (!document.createElement("canvas").getContext("webgl2")) return "this browser has no WebGL 2, or it is off";
    return null;
  };

  // The library is a script of the page like the others, only deflated; the page's policy names its hash.
  const loadLibrary = async () => {
    const script = document.createElement("script");
    script.textContent = new TextDecoder().decode(await reportData.inflate(find("#view-library").textContent));
    document.head.append(script);
    if (typeof THREE === "undefined") throw new Error("its library did not load");
    THREE.ColorManagement.enabled = false; // colors are bytes as they are to be seen
    return THREE;
  };

  class View {
    constructor(THREE, data, arrays, mesh) {
      this.THREE = THREE;
      this.data = data;
      Object.assign(this, reportScene.build(THREE, data, arrays, mesh));
      this.canvas = find("canvas");
      this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
      this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
      this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.002 * data.radius, 40 * data.radius);
      this.camera.up.fromArray(data.up);
      const lamp = new THREE.DirectionalLight(0xffffff, 0.45 * Math.PI);
      lamp.position.set(0.3, 0.5, 1);
      this.camera.add(lamp, lamp.target);
      this.scene.add(this.camera);
      this.controls = new THREE.OrbitControls(this.camera, this.canvas);
      this.controls.zoomToCursor = true;
      this.controls.enableZoom = false;
      this.controls.minDistance = 0.02 * data.radius;
      this.controls.maxDistance = 10 * data.radius;
      this.controls.listenToKeyEvents(this.canvas);
      this.controls.addEventListener("change", () => this.draw());
      this.row = 0;
      this.follows = false;
    }

    start() {
      this.look(Math.cos(ELEVATION), Math.sin(ELEVATION));
      this.resize();
      this.show(0);
      new ResizeObserver(() => this.resize()).observe(this.canvas);
    }

    // Draws once before the next frame of the screen, however often it is asked to.
    draw() {
      if (this.waiting) return;
      this.waiting = requestAnimationFrame(() => {
        this.waiting = 0;
        this.renderer.render(this.scene, this.camera);
      });
    }

    resize() {
      const { clientWidth, clientHeight } = this.canvas;
      if (!clientWidth || !clientHeight) return; // in print
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
      this.renderer.setSize(clientWidth, clientHeight, false);
      this.camera.aspect = clientWidth / clientHeight;
      this.place();
    }

    // From outside, towards the middle: `back` and `up` are the parts of the direction to the viewer.
    look(back, up) {
      const { center, radius } = this.data;
      const narrow = Math.min(this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1), 1) || 1;
      const distance = (0.9 * radius) / Math.sin((FIELD_OF_VIEW * Math.PI) / 360) / narrow;
      const away = this.data.back.map((value, axis) => back * value + up * this.data.up[axis]);
      this.follow(false);
      this.camera.position.fromArray(center.map((value, axis) => value + distance * away[axis]));
      this.controls.target.fromArray(center);
      this.controls.update();
      this.draw();
    }

    follow(follows) {
      if (follows === this.follows) return;
      this.follows = follows;
      find("[data-action=follow]").checked = follows;
      this.controls.enabled = !follows;
      if (follows) this.free = this.camera.position.clone();
      else this.camera.position.copy(this.free);
      this.place();
      if (!follows) this.controls.update();
    }

    // Where the view follows the camera: its pose and field of view.
    place() {
      const { camera, THREE } = this;
      camera.fov = FIELD_OF_VIEW;
      this.layers.current.visible = !this.follows && find("[data-layer=current]").checked;
      if (this.follows) {
        const { width, height, fx, fy } = this.data.camera;
        const half = Math.max(height / 2 / fy, width / 2 / fx / camera.aspect);
        camera.fov = (360 * Math.atan(half)) / Math.PI;
        camera.position.copy(this.poses.position(this.row));
        // The recording's cameras look along z with y down, three.js's along -z with y up: half a turn about x.
        camera.quaternion.copy(this.poses.rotation(this.row)).multiply(new THREE.Quaternion(1, 0, 0, 0));
      }
      camera.updateProjectionMatrix();
      this.draw();
    }

    show(row) {
      this.row = row;
      this.setRow(row);
      const { rows, times, lost, probability } = this.poses.arrays;
      const state = lost[row] ? "lost" : "tracked";
      const known = probability && Number.isFinite(probability[row]);
      const doubt = known ? ` · error probability ${Number(probability[row].toPrecision(2))}` : "";
      find(".timeline input").value = row;
      find("output").textContent = `frame ${rows[row]} · ${times[row].toFixed(2)} s · ${state}${doubt}`;
      this.place();
    }

    rowOf(frame) {
      const rows = this.poses.arrays.rows;
      let row = 0;
      while (row + 1 < rows.length && rows[row + 1] <= frame) row++;
      return row;
    }

    switchLayer(name, on) {
      if (name === "backs") this.layers.mesh.material.side = on ? this.THREE.DoubleSide : this.THREE.FrontSide;
      else this.layers[name].visible = on;
      if (name === "backs") this.layers.mesh.material.needsUpdate = true;
      this.place();
    }
  }

  // The slider's player: as fast as it was recorded.
  class Player {
    constructor(view, moveTo) {
      this.view = view;
      this.moveTo = moveTo;
      this.button = find("[data-action=play]");
      this.button.addEventListener("click", () => this.toggle());
    }

    toggle() {
      if (this.timer) {
        this.stop();
        return;
      }
      const times = this.view.poses.arrays.times;
      const last = times.length - 1;
      if (this.view.row === last) this.moveTo(0);
      const speed = Math.max(times[last] / LONGEST_PLAY_S, 1);
      const [from, started] = [times[this.view.row], performance.now()];
      this.button.textContent = "\u275A\u275A";
      this.button.setAttribute("aria-label", "pause");
      const step = (now) => {
        const time = from + (speed * Math.max(now - started, 0)) / 1000;
        let row = this.view.row;
        while (row < last && times[row + 1] <= time) row++;
        if (row !== this.view.row) this.moveTo(row);
        this.timer = requestAnimationFrame(step);
        if (row === last) this.stop();
      };
      this.timer = requestAnimationFrame(step);
    }

    stop() {
      cancelAnimationFrame(this.timer);
      this.timer = 0;
      this.button.textContent = "\u25B6";
      this.button.setAttribute("aria-label", "play");
    }
  }

  const connect = (view) => {
    const slider = find(".timeline input");
    slider.max = view.poses.count - 1;
    const moveTo = (row) => {
      view.show(row);
      const detail = { frame: view.poses.arrays.rows[row], from: "view" };
      document.dispatchEvent(new CustomEvent("report-frame", { detail }));
    };
    const player = new Player(view, moveTo);
    slider.addEventListener("input", () => {
      player.stop();
      moveTo(Number(slider.value));
    });
    document.addEventListener("report-frame", (event) => {
      if (event.detail.from === "view") return;
      player.stop();
      view.show(view.rowOf(event.detail.frame));
    });
    for (const box of root.querySelectorAll("[data-layer]")) {
      box.addEventListener("change", () => view.switchLayer(box.dataset.layer, box.checked));
      view.switchLayer(box.dataset.layer, box.checked); // a browser may remember another state than the page's
    }
    find("[data-action=follow]").checked = false;
    find("[data-action=follow]").addEventListener("change", (event) => view.follow(event.target.checked));
    find("[data-action=top]").addEventListener("click", () => view.look(0.02, 1));
    find("[data-action=reset]").addEventListener("click", () => view.look(Math.cos(ELEVATION), Math.sin(ELEVATION)));
    // The wheel scrolls the page until the view was clicked.
    const stage = find(".stage");
    const activate = (event) => {
      view.controls.enableZoom = stage.contains(event.target);
    };
    document.addEventListener("pointerdown", activate, { capture: true });
    stage.addEventListener("pointerdown", () => find(".hint").remove(), { once: true });
    view.canvas.addEventListener("webglcontextlost", () => explain("the browser took its graphics memory back"));
  };

  const main = async () => {
    const reason = missing();
    if (reason) {
      explain(reason);
      return;
    }
    try {
      const data = JSON.parse(find("#view-data").textContent);
      const THREE = await loadLibrary();
      const arrays = await reportData.arrays(data.poses);
      const mesh = data.mesh ? await reportData.mesh(data.mesh) : null;
      if (!mesh) for (const box of root.querySelectorAll("[data-layer=mesh], [data-layer=backs]")) box.parentNode.remove();
      find(".live").hidden = false;
      const view = new View(THREE, data, arrays, mesh);
      view.start();
      connect(view);
      root.classList.add("works");
    } catch (error) {
      explain(error.message);
    }
  };

  main();
})();
