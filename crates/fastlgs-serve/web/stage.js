// The picture: canvas, camera, mouse and touch input, and overlays (cameras, measurement, photo).

import { Camera, frustum } from "./camera.js";
import { Measure, pointAt } from "./measure.js";
import { OBJECT_ROWS, parseSplats } from "./frame.js";
import { openRenderer } from "./renderer.js";
import { getBlob, getBytes } from "./server.js";

// Largest length of the canvas's longer side, in pixels. Software rasterisers are too slow for
// more.
const MOST_PIXELS = 1280;

export class Stage {
  constructor(scene, elements, failed) {
    Object.assign(this, { scene, elements, failed });
    this.camera = new Camera(scene.up);
    this.mode = "color";
    this.objects = { selected: new Set(), hidden: new Set(), only: new Set(), scores: new Map(), text: null, list: [], members: () => [] };
    this.showCameras = false;
    this.compare = 0;
    this.measure = new Measure(scene.name);
    this.picked = () => {};
    this.pickedTogether = () => {};
    this.clicks = [];
    this.measured = () => {};
    this.looked = () => {};
  }

  async open(wish) {
    // No pictures are rendered during training, and a static folder has no server.
    const alone = this.scene.stage === "training" || Boolean(this.scene.shared);
    this.renderer = await openRenderer(this.elements.canvas, wish, alone);
    this.renderer.lost.then(() => this.failed(new Error("the browser lost its graphics device; reload the page")));
    this.sorter = new Worker("./sorter.js");
    this.sorter.onmessage = ({ data }) => this.sorted(data);
    new ResizeObserver(() => this.resize()).observe(this.elements.stage);
    this.listen();
    this.resize();
  }

  // Fetches the Gaussians; called again when a scene in training has new ones.
  async load() {
    if (this.renderer.name === "pictures") return this.drawNow();
    this.splats = parseSplats(await getBytes("/api/splats"));
    this.renderer.setSplats(this.splats);
    this.renderer.setObjects(this.objectBytes());
    this.sorter.postMessage({ means: this.splats.means });
    this.sorting = false;
    this.loading = (this.loading ?? 0) + 1;
    return this.settle();
  }

  resize() {
    const box = this.elements.stage.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio, MOST_PIXELS / Math.max(box.width, box.height, 1));
    const size = [box.width, box.height].map((n) => Math.max(1, Math.round(n * ratio)));
    for (const canvas of [this.elements.canvas, this.elements.cameras]) [canvas.width, canvas.height] = size;
    [this.width, this.height] = size;
    this.ratio = ratio;
    this.changed();
  }

  lookFrom(index) {
    this.index = index;
    this.camera.lookFrom(this.scene.views[index]);
    this.elements.photo.hidden = true;
    this.looked(index);
    return this.settle();
  }

  // Redraws. The returned promise resolves when a frame with sorted Gaussians was drawn.
  settle() {
    const settled = new Promise((done) => (this.settled = [...(this.settled ?? []), done]));
    this.changed();
    return settled;
  }

  changed() {
    if (!this.camera.view) return;
    if (this.splats && this.splats.count > 0) {
      if (this.sorting) this.sortAgain = true;
      else this.sort();
    }
    this.draw();
    // Without Gaussians there is nothing to sort.
    if (!this.splats?.count) this.finish();
  }

  sort() {
    const m = this.camera.worldToCamera();
    this.sorting = true;
    this.sortAgain = false;
    this.sorter.postMessage({ depth: [m[2], m[6], m[10], m[14]], number: this.loading });
  }

  sorted({ order, number }) {
    // Ignores the order of Gaussians that were replaced meanwhile.
    if (number === this.loading) {
      this.renderer.setOrder(order);
      this.ordered = true;
    }
    if (number !== this.loading || this.sortAgain) return this.sort();
    this.sorting = false;
    this.draw();
    this.finish();
  }

  finish() {
    const settled = this.settled ?? [];
    this.settled = [];
    requestAnimationFrame(() => requestAnimationFrame(() => settled.forEach((done) => done())));
  }

  draw() {
    if (this.pending || !this.renderer) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.drawNow();
    });
  }

  frame() {
    const { camera, width, height, scene, mode, objects, failed } = this;
    const { selected, hidden, only, text } = objects;
    const sets = { selected: [...selected], hidden: [...hidden], only: [...only] };
    return { camera, width, height, scene, mode, text, failed, dim: selected.size > 0, ...sets };
  }

  drawNow() {
    if (!this.camera.view || !(this.splats || this.renderer.name === "pictures")) return;
    const drawn = this.renderer.draw(this.frame());
    // Time from opening the page to the first picture, in milliseconds.
    if (this.ordered || this.renderer.name === "pictures") Promise.resolve(drawn).then(() => (this.firstPicture ??= performance.now()));
    this.drawOver();
    this.placePhoto();
    return drawn;
  }

  // Returns the current picture as a PNG blob.
  async snapshot() {
    await this.drawNow();
    return new Promise((done) => this.elements.canvas.toBlob(done, "image/png"));
  }

  setMode(mode) {
    this.mode = mode;
    this.draw();
  }

  // Sets the selected, hidden, isolated and relevant objects; see app.js.
  setObjects(objects) {
    this.objects = objects;
    this.renderer.setObjects(this.objectBytes());
    this.draw();
  }

  objectBytes() {
    const bytes = new Uint8Array(4 * 256 * OBJECT_ROWS);
    const { list, selected, scores, members } = this.objects;
    for (const { id, color } of [{ id: 0, color: [0, 0, 0] }, ...list]) {
      // Parts inherit relevancy, selection and visibility from the objects that contain them.
      const around = members(id);
      const score = Math.max(0, ...around.map((above) => scores.get(above) ?? 0));
      const lit = around.some((above) => selected.has(above));
      bytes.set([Math.round(255 * score), lit ? 255 : 0, this.isShown(id) ? 0 : 255, 255], 4 * id);
      bytes.set([...color, 255], 4 * (65536 + id));
    }
    return bytes;
  }

  // Returns whether the Gaussians of an id are visible.
  isShown(id) {
    const { hidden, only, members } = this.objects;
    const around = members(id);
    const any = (set) => around.some((above) => set.has(above));
    return !any(hidden) && (only.size === 0 || any(only));
  }

  // Draws the overlays: the cameras of the photos, and the measurement.
  drawOver() {
    const context = this.elements.cameras.getContext("2d");
    context.clearRect(0, 0, this.width, this.height);
    const lens = this.camera.lens(this.width, this.height);
    if (this.showCameras) this.drawCameras(context, lens);
    if (this.measure.on) this.drawMeasure(context, lens);
  }

  drawMeasure(context, lens) {
    const places = this.measure.points.map((point) => this.camera.project(point, lens));
    if (places.some((place) => !place)) return;
    const [a, b] = places;
    Object.assign(context, { strokeStyle: "#fff", fillStyle: "#fff", lineWidth: 2 * this.ratio, font: `${14 * this.ratio}px sans-serif` });
    for (const [x, y] of places) {
      context.beginPath();
      context.arc(x, y, 4 * this.ratio, 0, 2 * Math.PI);
      context.fill();
    }
    if (!b) return;
    context.beginPath();
    context.moveTo(...a);
    context.lineTo(...b);
    context.stroke();
    // Dark outline, so that the text is readable on any background.
    const middle = [(a[0] + b[0]) / 2 + 8 * this.ratio, (a[1] + b[1]) / 2 - 8 * this.ratio];
    context.strokeStyle = "#000";
    context.strokeText(this.measure.text(), ...middle);
    context.fillText(this.measure.text(), ...middle);
  }

  drawCameras(context, lens) {
    context.lineWidth = 1;
    for (const [index, view] of this.scene.views.entries()) {
      if (index === this.index && !this.camera.moved) continue;
      const { apex, corners } = frustum(view, 0.08 * view.focus);
      const [top, ...base] = [apex, ...corners].map((p) => this.camera.project(p, lens));
      if (!top || base.some((p) => !p)) continue;
      context.strokeStyle = view.held_out ? "#58b6ff" : "#ff8a3c";
      context.beginPath();
      base.forEach((p, k) => {
        context.moveTo(...top);
        context.lineTo(...p);
        context.lineTo(...base[(k + 1) % 4]);
      });
      context.stroke();
    }
  }

  // Shows the photo over the picture while the camera is at its pose.
  placePhoto() {
    const { photo, divider } = this.elements;
    const view = this.camera.view;
    const wanted = this.compare > 0 && !this.camera.moved && view.photo;
    if (wanted && this.photo?.view !== view) this.fetchPhoto(view);
    const shown = wanted && this.photo.there;
    photo.hidden = divider.hidden = !shown;
    if (!shown) return;
    const { picture } = this.camera.lens(this.width, this.height);
    const css = (v) => `${v / this.ratio}px`;
    Object.assign(photo.style, { left: css(picture.left), top: css(picture.top), width: css(picture.width), height: css(picture.height) });
    photo.style.clipPath = `inset(0 ${100 - this.compare}% 0 0)`;
    const at = picture.left + picture.width * this.compare / 100;
    Object.assign(divider.style, { left: css(at), top: css(picture.top), height: css(picture.height) });
  }

  // Fetches the photo of a view. Ignores it if another photo was requested meanwhile.
  async fetchPhoto(view) {
    const own = this.photo = { view, there: false };
    try {
      const blob = await getBlob(`/api/photos/${encodeURIComponent(view.name)}`);
      if (this.photo !== own) return;
      URL.revokeObjectURL(this.elements.photo.src);
      this.elements.photo.src = URL.createObjectURL(blob);
      own.there = true;
      this.placePhoto();
    } catch (error) {
      this.failed(error);
    }
  }

  // Mouse, touch and wheel. Keys are in app.js.
  listen() {
    const { canvas } = this.elements;
    const pointers = new Map();
    // Movements up to this share of the image height still count as a click.
    const CLICK_TOLERANCE = 0.01;
    let dragging = false;
    const place = (event) => [event.offsetX * this.ratio, event.offsetY * this.ratio];
    const spread = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, place(event));
      dragging = pointers.size > 1;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const now = place(event);
      const [dx, dy] = [(now[0] - before[0]) / this.height, (now[1] - before[1]) / this.height];
      if (!dragging && Math.abs(dx) + Math.abs(dy) < CLICK_TOLERANCE) return;
      dragging = true;
      if (pointers.size === 2) {
        const old = spread([...pointers.values()]);
        pointers.set(event.pointerId, now);
        this.camera.zoom(old / Math.max(spread([...pointers.values()]), 1));
        this.camera.move(dx / 2, dy / 2);
      } else {
        pointers.set(event.pointerId, now);
        if (event.buttons & 2 || event.shiftKey) this.camera.move(dx, dy);
        else this.camera.turn(-3 * dx, 3 * dy);
      }
      this.changed();
    });
    const end = (event) => {
      if (event.type === "pointerup" && pointers.size === 1 && !dragging && event.button === 0) this.click(...place(event), event.shiftKey);
      pointers.delete(event.pointerId);
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.zoom(Math.exp(event.deltaY * 0.001));
      this.changed();
    }, { passive: false });
  }

  // Returns the surface point at a canvas position. The `pictures` renderer fetches the Gaussians
  // for this.
  async point(x, y) {
    const splats = this.splats ?? (this.fetched ??= parseSplats(await getBytes("/api/splats")));
    return pointAt(splats, this.camera, this.camera.lens(this.width, this.height), x, y, (id) => this.isShown(id));
  }

  // Handles a click. With `together`, it belongs to the same object as the click before.
  async click(x, y, together = false) {
    if (this.measure.on) {
      try {
        const point = await this.point(x, y);
        if (!point) throw new Error("there is no surface at this point; click another one");
        this.measure.add(point);
        this.measured();
      } catch (error) {
        this.failed(error);
      }
      return this.draw();
    }
    if (this.showCameras) {
      const lens = this.camera.lens(this.width, this.height);
      const near = (view) => {
        const p = this.camera.project(frustum(view, 0.04 * view.focus).apex, lens);
        return p ? Math.hypot(p[0] - x, p[1] - y) : Infinity;
      };
      const distances = this.scene.views.map(near);
      const nearest = distances.indexOf(Math.min(...distances));
      if (distances[nearest] < 12 * this.ratio) return this.lookFrom(nearest);
    }
    try {
      const within = (v, size) => Math.min(Math.max(Math.floor(v), 0), size - 1);
      const place = [within(x, this.width), within(y, this.height)];
      // Stored as rays, because the selection panel may change the size of the canvas.
      const lens = this.camera.lens(this.width, this.height);
      const ray = [(place[0] + 0.5 - lens.cx) / lens.fx, (place[1] + 0.5 - lens.cy) / lens.fy];
      const from = this.camera.pose().join();
      this.clicks = together && this.clickedFrom === from ? [...this.clicks, ray] : [ray];
      this.clickedFrom = from;
      // Only the server can combine several clicks.
      if (this.clicks.length > 1 && !this.scene.shared) return this.pickedTogether(this.clicks);
      const own = this.clicks;
      const id = await this.renderer.pick(this.frame(), ...place);
      // Ignored if there was another click or query meanwhile.
      if (this.clicks === own) this.picked(id);
    } catch (error) {
      this.failed(error);
    }
  }
}
