// Objects as the page knows them: what contains what, and their buttons with pictures.

import { getBlob } from "./server.js";

export class Objects {
  constructor(list, overlaps, supportShare) {
    this.list = list;
    // What the ids of Gaussians above those of the objects stand for, from small to large.
    this.overlaps = overlaps;
    this.supportShare = supportShare;
    this.byId = new Map(list.map((o) => [o.id, o]));
    this.children = new Map();
    for (const o of list) this.children.set(o.parent, [...(this.children.get(o.parent) ?? []), o.id]);
    const bySize = (a, b) => this.byId.get(b).gaussians - this.byId.get(a).gaussians;
    for (const ids of this.children.values()) ids.sort(bySize);
    this.pictures = new Map();
    this.chain = this.chain.bind(this);
    // All ids that Gaussians have, with the color of the smallest object that each stands for.
    this.colored = list.concat(overlaps.map(([smallest], k) => ({ id: list.length + 1 + k, color: this.byId.get(smallest).color })));
  }

  // An object and what contains it, from small to large; those that a Gaussian of this id lies in.
  chain(id) {
    if (id > this.list.length) return this.overlaps[id - this.list.length - 1] ?? [];
    const chain = [];
    for (let own = this.byId.get(id); own && !chain.includes(own.id); own = this.byId.get(own.parent)) chain.push(own.id);
    return chain;
  }

  // Whether the middle of an object lies in the picture.
  isInSight(id, { camera, width, height }) {
    const box = this.byId.get(id).bbox3d;
    const place = box && camera.project(box[0].map((low, k) => (low + box[1][k]) / 2), camera.lens(width, height));
    return Boolean(place) && place.every((v, k) => v > 0 && v < [width, height][k]);
  }

  parts(id) {
    return this.children.get(id) ?? [];
  }

  // Of things that lie in each other, the largest whose support comes near the best (fastlgs_grid::query::pointed).
  meant(id) {
    const chain = this.chain(id);
    const support = (id) => this.byId.get(id).support * (1 - this.byId.get(id).share);
    const best = Math.max(...chain.map(support));
    return chain.findLast((id) => support(id) >= this.supportShare * best);
  }

  // The next smaller thing around `id` below `selected`; where there is none, the largest again.
  below(id, selected) {
    const chain = this.chain(id);
    const at = chain.indexOf(selected);
    return at > 0 ? chain[at - 1] : this.meant(id);
  }

  async picture(id) {
    if (!this.pictures.has(id)) {
      const made = getBlob(`/api/objects/${id}/thumbnail.png`).then((blob) => URL.createObjectURL(blob), ({ status }) => {
        // Whoever lists it again asks again, unless there is none.
        if (status !== 404) this.pictures.delete(id);
        return null;
      });
      this.pictures.set(id, made);
    }
    return this.pictures.get(id);
  }

  // Fills a list with a button for each of `rows`: { id, score }.
  fill(element, rows, { selected, hidden, minScore, choose }) {
    element.replaceChildren(...rows.map(({ id, score }) => {
      const button = document.createElement("button");
      button.dataset.id = id;
      button.classList.toggle("selected", selected.has(id));
      button.classList.toggle("hidden-object", hidden.has(id));
      button.setAttribute("aria-pressed", selected.has(id));
      const image = document.createElement("img");
      image.alt = "";
      image.loading = "lazy";
      const name = document.createElement("span");
      name.textContent = score === undefined ? `#${id}` : `#${id}  ${score.toFixed(2)}`;
      button.append(image, name);
      if (score !== undefined) {
        const meter = document.createElement("meter");
        meter.className = "score";
        Object.assign(meter, { min: 0, max: 1, low: minScore, high: minScore, optimum: 1, value: score });
        meter.setAttribute("aria-label", `relevancy ${score.toFixed(2)}`);
        button.append(meter);
      }
      button.addEventListener("click", () => choose(id));
      // Only what comes into sight is asked for.
      new IntersectionObserver(async (entries, observer) => {
        if (!entries.some((entry) => entry.isIntersecting)) return;
        observer.disconnect();
        const url = await this.picture(id);
        if (url) image.src = url;
      }).observe(button);
      const item = document.createElement("li");
      item.append(button);
      return item;
    }));
  }
}
