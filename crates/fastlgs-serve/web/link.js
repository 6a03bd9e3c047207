// What one sees, as the part of an address after #: a place, or the view that it is the place of, and what was asked.

const SHOWN = ["relevancy", "objects"];

export function linkOf(camera, { text, mode }) {
  const parts = new URLSearchParams({ view: camera.view.name });
  if (camera.moved) parts.set("camera", camera.pose().map((n) => Number(n.toPrecision(6))).join("_"));
  if (text) parts.set("text", text);
  if (mode !== "color") parts.set("show", mode);
  return `#${parts}`;
}

// Puts the camera where a link says; the link's text and what it shows, if any. A link that cannot be read throws.
export function follow(hash, stage) {
  const parts = new URLSearchParams(hash.slice(1));
  const name = parts.get("view");
  if (name === null) return {};
  const index = stage.scene.views.findIndex((view) => view.name === name);
  if (index < 0) throw new Error(`the link leads to the view "${name}", which this scene does not have`);
  stage.lookFrom(index);
  const pose = parts.get("camera")?.split("_").map(Number);
  if (pose && !stage.camera.stand(pose)) throw new Error("the link's camera cannot be read; this is the view that it was near");
  stage.changed();
  return { text: parts.get("text"), mode: SHOWN.find((mode) => mode === parts.get("show")) ?? "color" };
}
