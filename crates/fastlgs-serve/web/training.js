// A scene in training: its curves, and new Gaussians when the server has a new snapshot.

import { getJson } from "./server.js";

const POLL_INTERVAL_MS = 1000;

// Polls a run until the scene answers queries. Calls `onSplats` when there are new Gaussians.
export async function follow(elements, onSplats) {
  elements.training.hidden = false;
  let revision = 0;
  for (;;) {
    try {
      const progress = await getJson("/api/training");
      show(elements, progress, "training is done, objects are being found");
      if (progress.revision !== revision) {
        await onSplats();
        revision = progress.revision;
      }
      if ((await getJson("/api/scene")).stage === "ready") return;
    } catch (error) {
      // After an error, such as a busy server, the next poll tries again.
      elements.text.textContent = `${error.message}; trying again`;
    }
    await new Promise((done) => setTimeout(done, POLL_INTERVAL_MS));
  }
}

// Shows the curves of a finished run.
export async function recall(elements) {
  elements.training.hidden = false;
  show(elements, await getJson("/api/training"), "trained");
}

function show(elements, { curve, iterations, finished }, over) {
  const last = curve.at(-1);
  const state = finished ? over : `step ${last?.iteration ?? 0} of ${iterations}`;
  elements.text.textContent = last
    ? `${state}: ${last.gaussians.toLocaleString("en")} Gaussians, ${last.psnr.toFixed(1)} dB, ${Math.round(last.seconds)} s`
    : "training is starting";
  const points = (of) => curve.filter((p) => of(p) !== null && Number.isFinite(of(p))).map((p) => [p.iteration, of(p)]);
  plot(elements.loss, "loss", iterations, [["", points((p) => p.loss)]]);
  plot(elements.psnr, "PSNR in dB (blue: held out)", iterations, [
    ["", points((p) => p.psnr)],
    ["held-out", points((p) => p.psnr_held_out)],
  ]);
}

// Draws curves into a box of 300 x 90 units.
function plot(svg, title, most, lines) {
  const values = lines.flatMap(([, points]) => points.map((p) => p[1]));
  const low = Math.min(...values), high = Math.max(...values);
  const element = (name, attributes, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.textContent = text;
    return made;
  };
  const at = ([x, y]) => `${(4 + 292 * x / most).toFixed(1)},${(84 - 66 * (y - low) / Math.max(high - low, 1e-9)).toFixed(1)}`;
  svg.replaceChildren(
    element("text", { x: 4, y: 11 }, values.length ? `${title}: ${values.at(-1).toPrecision(3)}  (${low.toPrecision(3)} to ${high.toPrecision(3)})` : title),
    ...lines.map(([name, points]) => element("polyline", { class: name, points: points.map(at).join(" ") })),
  );
}
