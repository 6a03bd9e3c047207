// Objects of the page: their hierarchy, and their buttons with pictures.

import { getBlob } from "./server.js";

export class Objects {
  constructor(list, overlaps, supportShare) {
    this.list = list;
    // Overlap lists, for Gaussian ids above the number of objects; each from small to large.
    this.overlaps = overlaps;
    this.supportShare = supportShare;
    this.byId = new Map(list.map((o) => [o.id, o]));
    this.children = new Map();
    for (const o of list) this.children.set(o.parent, [...(this.children.get(o.parent) ?? []), o.id]);
    const bySize = (a, b) => this.byId.get(b).gaussians - this.byId.get(a).gaussians;
    for (const ids of this.children.values()) ids.sort(bySize);
    this.pictures = new Map();
    this.names = new Map(); // likeliest names of each object, once they are loaded
    this.chain = this.chain.bind(this);
    // All Gaussian ids, each with the colour of its smallest object.
    this.colored = list.concat(overlaps.map(([smallest], k) => ({ id: list.length + 1 + k, color: this.byId.get(smallest).color })));
  }

  // Returns the objects of a Gaussian id, from small to large: an object and those that contain it,
  // or an overlap list.
  chain(id) {
    if (id > this.list.length) return this.overlaps[id - this.list.length - 1] ?? [];
    const chain = [];
    for (let own = this.byId.get(id); own && !chain.includes(own.id); own = this.byId.get(own.parent)) chain.push(own.id);
    return chain;
  }

  // Returns whether the centre of an object's box is in the picture.
  isInSight(id, { camera, width, height }) {
    const box = this.byId.get(id).bbox3d;
    const place = box && camera.project(box[0].map((low, k) => (low + box[1][k]) / 2), camera.lens(width, height));
    return Boolean(place) && place.every((v, k) => v > 0 && v < [width, height][k]);
  }

  // Takes the likeliest names of all objects, in order of their ids.
  setNames(names) {
    this.names = new Map(this.list.map((o, k) => [o.id, names[k]]));
  }

  // Returns the id of an object with its likeliest name.
  title(id) {
    const [likeliest] = this.names.get(id) ?? [];
    return likeliest ? `#${id} ${likeliest.name}?` : `#${id}`;
  }

  // Returns the ids of all objects and parts, the largest first.
  bySize() {
    return this.list.toSorted((a, b) => b.share - a.share).map((o) => o.id);
  }

  parts(id) {
    return this.children.get(id) ?? [];
  }

  // Returns the largest object of a Gaussian id whose support x (1 - share) is close to the best,
  // like fastlgs_grid::query::select_at_pixels for one pixel.
  meant(id) {
    const chain = this.chain(id);
    const support = (id) => this.byId.get(id).support * (1 - this.byId.get(id).share);
    const best = Math.max(...chain.map(support));
    return chain.findLast((id) => support(id) >= this.supportShare * best);
  }

  // Returns the next smaller object of a Gaussian id below `selected`, or starts again at the
  // largest.
  below(id, selected) {
    const chain = this.chain(id);
    const at = chain.indexOf(selected);
    return at > 0 ? chain[at - 1] : this.meant(id);
  }

  async picture(id) {
    if (!this.pictures.has(id)) {
      const made = getBlob(`/api/objects/${id}/thumbnail.png`).then((blob) => URL.createObjectURL(blob), ({ status }) => {
        // After an error, the next listing tries again, unless there is no picture (404).
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
      name.textContent = score === undefined ? this.title(id) : `${this.title(id)}  ${score.toFixed(2)}`;
      button.append(image, name);
      if (score !== undefined) {
        const meter = document.createElement("meter");
        meter.className = "score";
        Object.assign(meter, { min: 0, max: 1, low: minScore, high: minScore, optimum: 1, value: score });
        meter.setAttribute("aria-label", `score ${score.toFixed(2)}`);
        button.append(meter);
      }
      button.addEventListener("click", () => choose(id));
      // Fetches the picture only when the button becomes visible.
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
