// Links to the state of the page: the part of an address after #, with view, camera, text and mode.

const MODES = ["relevancy", "objects"];

export function linkOf(camera, { text, mode }) {
  const parts = new URLSearchParams({ view: camera.view.name });
  if (camera.moved) parts.set("camera", camera.pose().map((n) => Number(n.toPrecision(6))).join("_"));
  if (text) parts.set("text", text);
  if (mode !== "color") parts.set("show", mode);
  return `#${parts}`;
}

// Sets the camera from a link. Returns the text and mode of the link, if any. Throws if the link is
// invalid.
export function follow(hash, stage) {
  const parts = new URLSearchParams(hash.slice(1));
  const name = parts.get("view");
  if (name === null) return {};
  const index = stage.scene.views.findIndex((view) => view.name === name);
  if (index < 0) throw new Error(`the link names the view "${name}", which this scene does not have`);
  stage.lookFrom(index);
  const pose = parts.get("camera")?.split("_").map(Number);
  if (pose && !stage.camera.stand(pose)) throw new Error("the camera of the link is invalid; its view is shown instead");
  stage.changed();
  return { text: parts.get("text"), mode: MODES.find((mode) => mode === parts.get("show")) ?? "color" };
}
