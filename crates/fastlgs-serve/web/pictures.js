// Renderer that shows pictures of the server, for browsers without a GPU.

import { postBlob, postJson } from "./server.js";

// Longer side of the pictures in pixels. A server without a GPU renders this size quickly.
const SIDE = 640;

export async function openPictures(canvas) {
  const context = canvas.getContext("2d");
  let busy = false, next = null, drawn = Promise.resolve();

  async function work() {
    while (next) {
      const frame = next;
      next = null;
      const camera = frame.camera.asJson(frame.width, frame.height, SIDE);
      const what = frame.mode === "relevancy" && frame.text ? "heatmap" : frame.mode === "objects" ? "objects" : "color";
      const body = { camera, what, selected: frame.dim && what === "color" ? frame.selected : [], hidden: frame.hidden, only: frame.only };
      if (what === "heatmap") body.text = frame.text;
      const picture = await createImageBitmap(await postBlob("/api/render", body));
      context.drawImage(picture, 0, 0, frame.width, frame.height);
    }
  }

  return {
    lost: new Promise(() => {}),
    setSplats() {},
    setObjects() {},
    setOrder() {},
    // While one frame is being fetched, only the newest of the others is kept.
    draw(frame) {
      next = { ...frame, camera: Object.assign(Object.create(Object.getPrototypeOf(frame.camera)), frame.camera) };
      if (busy) return drawn;
      busy = true;
      drawn = work().catch(frame.failed).finally(() => { busy = false; });
      return drawn;
    },
    async pick(frame, x, y) {
      const camera = frame.camera.asJson(frame.width, frame.height, SIDE);
      const at = (v, size, own) => Math.min(own - 1, Math.floor((v + 0.5) / size * own));
      const point = [at(x, frame.width, camera.width), at(y, frame.height, camera.height)];
      const answer = await postJson("/api/query", { point, camera, hidden: frame.hidden, only: frame.only });
      return answer.candidates[0]?.id ?? 0;
    },
  };
}
