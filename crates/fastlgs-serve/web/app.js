// The page: the state of queries, selection and visibility, and the controls for it.

import { follow as followLink, linkOf } from "./link.js";
import { Objects } from "./objects.js";
import { Recent } from "./recent.js";
import { readable } from "./sentence.js";
import { Stage } from "./stage.js";
import { follow, recall } from "./training.js";
import { save } from "./save.js";
import { getBlob, getJson, postJson } from "./server.js";

const $ = (id) => document.getElementById(id);
const LISTED = 24; // objects listed before "more"
const NEAREST = 3; // objects named if nothing is found
const ASKED_SIDE = 640; // longer side of the view that is queried, in pixels

let scene, stage, objects, recent;
const state = { selected: new Set(), hidden: new Set(), only: new Set(), scores: new Map(), ranked: null, text: null, linkText: null, listed: LISTED };

function failed(error) {
  $("problem").textContent = readable(error.message);
  $("problem").hidden = false;
  clearTimeout(failed.timer);
  failed.timer = setTimeout(() => { $("problem").hidden = true; }, 8000);
}

// Wraps an event handler: errors are shown on the page, not thrown.
const withErrors = (work) => async (...args) => {
  try {
    await work(...args);
  } catch (error) {
    failed(error);
  }
};

function say(text, absent = false) {
  $("answer").textContent = text;
  $("answer").classList.toggle("absent", absent);
}

// Updates the picture, the lists and the buttons from the state.
function update() {
  const { selected, hidden, only, scores, text } = state;
  stage.setObjects({ selected, hidden, only, scores, text, list: objects.colored, members: objects.chain });
  const options = { selected, hidden, minScore: scene.min_score, choose: (id) => select([id]) };
  const rows = state.ranked ?? objects.bySize().map((id) => ({ id }));
  $("list-title").textContent = state.ranked ? `Most relevant to "${state.text}"` : "Objects";
  objects.fill($("list"), rows.slice(0, state.listed), options);
  $("more").hidden = rows.length <= state.listed;
  $("selection").hidden = selected.size === 0;
  $("naming").hidden = selected.size !== 1 || Boolean(scene.shared);
  $("show-all").disabled = hidden.size + only.size === 0;
  if (selected.size === 0) return;
  const [first] = selected;
  const chain = selected.size === 1 ? objects.chain(first).reverse() : [...selected];
  $("chain").replaceChildren(...chain.map((id) => {
    const button = document.createElement("button");
    button.textContent = `#${id}`;
    button.setAttribute("aria-current", selected.has(id));
    button.addEventListener("click", () => select([id]));
    return button;
  }));
  const own = [...selected].map((id) => objects.byId.get(id));
  const sum = own.reduce((n, o) => n + o.gaussians, 0).toLocaleString("en");
  $("facts").textContent = own.length === 1
    ? `${sum} Gaussians, visible in ${own[0].views} photos, support ${own[0].support.toFixed(2)} (IoU with masks)`
    : `${own.length} objects, ${sum} Gaussians`;
  const parts = own.length === 1 ? objects.parts(first).map((id) => ({ id })) : [];
  $("parts-title").hidden = parts.length === 0;
  objects.fill($("parts"), parts, options);
}

function select(ids) {
  state.selected = new Set(ids);
  update();
}

// Queries a text in the current view.
const ask = (text) => {
  const camera = stage.camera.asJson(stage.width, stage.height, ASKED_SIDE);
  return postJson("/api/query", { text, camera, candidates: objects.list.length });
};

// Returns the view to go to for an answer that is not visible here, if any. A static folder knows
// the positions of objects, but not whether they are hidden.
async function elsewhere(answer) {
  if (!answer.found || answer.seen_best || answer.pixels !== undefined) return answer.seen_best;
  const [{ id }] = answer.objects;
  return objects.isInSight(id, stage) ? null : bestView(id);
}

const bestView = async (id) => (await getJson(`/api/objects/${id}/view`)).view;

// Goes to the view of this name; does nothing without a name.
const lookFrom = (name) => name && stage.lookFrom(scene.views.findIndex((view) => view.name === name));

// Number of queries that were started or cancelled. Answers to earlier queries are ignored.
let queryNumber = 0;

const find = withErrors(async (text) => {
  if (!objects) return;
  if (!text.trim()) return clear();
  const number = ++queryNumber;
  const isLate = () => number !== queryNumber;
  say(`searching for "${text}" ...`);
  try {
    const found = await answered(text, isLate);
    if (!isLate()) show(text, found);
  } catch (error) {
    if (!isLate()) say("");
    throw error;
  }
});

// Queries a text in the current view. If its answer is hardly visible, goes to the best view and
// queries there. Returns the answer, and the best view if it was used.
async function answered(text, isLate) {
  const answer = await ask(text);
  const best = isLate() ? null : await elsewhere(answer);
  if (!best || isLate()) return { answer };
  lookFrom(best);
  return { answer: await ask(text), best };
}

function show(text, { answer, best }) {
  recent.asked(text);
  stage.clicks = [];
  state.text = text;
  state.ranked = answer.candidates;
  state.scores = new Map(answer.candidates.map(({ id, score }) => [id, score]));
  state.listed = LISTED;
  const ms = Math.round(answer.ms.total);
  if (answer.found) {
    const parts = answer.objects.length === 1 ? `#${answer.objects[0].id}` : `${answer.objects.length} objects`;
    // Answers of a static folder have no pixels.
    const pixels = answer.pixels === undefined ? "" : `, ${answer.pixels.toLocaleString("en")} pixels here`;
    const gone = best ? `, seen best in ${best}` : "";
    say(`"${text}": ${parts}, score ${answer.score.toFixed(2)}${pixels}${gone} (${ms} ms)`);
  } else {
    const near = answer.candidates.slice(0, NEAREST).map(({ id }) => objects.title(id)).join(", ");
    const accept = scene.shared ? "" : `; if one of them is meant, select it and name it "${text}"`;
    const refusal = answer.known === false
      ? `The built-in encoder does not know "${text}": click on the object`
      : `"${text}" is not found in this scene: the best object scores ${answer.score.toFixed(2)}, at least ${scene.min_score.toFixed(2)} is needed. Nearest: ${near}`;
    say(`${refusal}${accept} (${ms} ms)`, true);
    // The name is offered for the object that is selected next.
    $("its-name").value = text;
  }
  select(answer.objects.map((o) => o.id));
}

const nameIt = withErrors(async (name) => {
  const [object] = state.selected;
  const taught = await postJson("/api/names", { name, object });
  $("its-name").value = "";
  recent.taught(await getJson("/api/names"));
  say(`#${object} is called "${taught.name}" now; ${taught.views.toLocaleString("en")} embeddings are stored`);
});

function clear() {
  if (!objects) return;
  queryNumber += 1;
  stage.clicks = [];
  Object.assign(state, { selected: new Set(), scores: new Map(), ranked: null, text: null, listed: LISTED });
  say("");
  update();
}

function setMode(mode) {
  document.querySelector(`#modes input[value=${mode}]`).checked = true;
  stage.setMode(mode);
}

function step(by) {
  const count = scene.views.length;
  return stage.lookFrom((stage.index + by + count) % count);
}

function setCompare(value) {
  stage.compare = Number(value);
  $("compare").value = value;
  // The photo fits only its own view.
  if (stage.compare > 0 && stage.camera.moved) stage.lookFrom(stage.index);
  stage.draw();
}

const exported = withErrors(async (keep) => {
  const format = $("format").value;
  const ids = [...state.selected].join(",");
  save(await getBlob(`/api/export?objects=${ids}&format=${format}&keep=${keep}`), `${scene.name}-${keep ? "selection" : "rest"}.${format}`);
});

function measure(on = !stage.measure.on) {
  stage.measure.on = on;
  stage.measure.points = [];
  $("measure").setAttribute("aria-pressed", on);
  measured();
  stage.draw();
}

function measured() {
  const length = stage.measure.text();
  $("length").textContent = length || (stage.measure.on ? "click two points" : "");
  $("known").hidden = !length;
}

const link = withErrors(async () => {
  history.replaceState(null, "", linkOf(stage.camera, { text: state.text, mode: stage.mode }));
  // Browsers allow access to the clipboard only on localhost and over HTTPS.
  const copied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
  say(copied ? "the link to this view was copied" : "the link to this view is in the address bar");
});

const followed = withErrors(async () => {
  const { text, mode } = followLink(location.hash, stage);
  if (mode) setMode(mode);
  state.wish = text;
  if (objects) await queryLinkText();
});

// Queries the text of the link.
async function queryLinkText() {
  const text = state.wish;
  state.wish = null;
  if (!text) return;
  $("text").value = text;
  await find(text);
}

const actions = {
  isolate: () => {
    state.only = new Set(state.selected);
    update();
  },
  hide: () => {
    state.hidden = new Set([...state.hidden, ...state.selected]);
    select([]);
  },
  "show-all": () => {
    state.hidden = new Set();
    state.only = new Set();
    update();
  },
  clear,
  best: withErrors(async () => lookFrom(await bestView([...state.selected][0]))),
  measure: () => measure(),
  link,
  export: () => exported(true),
  "export-rest": () => exported(false),
  more: () => {
    state.listed += 4 * LISTED;
    update();
  },
  previous: () => step(-1),
  next: () => step(1),
  save: withErrors(async () => save(await stage.snapshot(), `${scene.name}.png`)),
};

const cameras = () => {
  stage.showCameras = $("show-cameras").checked;
  stage.draw();
};

const keys = {
  "/": () => $("text").focus(),
  "[": () => step(-1),
  "]": () => step(1),
  1: () => setMode("color"),
  2: () => setMode("relevancy"),
  3: () => setMode("objects"),
  c: () => {
    $("show-cameras").checked = !$("show-cameras").checked;
    cameras();
  },
  p: () => setCompare(stage.compare > 0 ? 0 : 50),
  i: actions.isolate,
  x: actions.hide,
  a: actions["show-all"],
  b: () => state.selected.size > 0 && actions.best(),
  n: () => $("its-name").focus(),
  m: actions.measure,
  l: link,
  s: actions.save,
  Escape: () => (stage.measure.on ? measure(false) : clear()),
  "+": () => stage.camera.zoom(0.9),
  "=": () => stage.camera.zoom(0.9),
  "-": () => stage.camera.zoom(1.1),
};

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target.matches("input[type=search], input[type=number], #its-name, select");
  if (typing) {
    if (event.key === "Escape") $("canvas").focus();
    return;
  }
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const arrow = event.target === $("canvas") && arrows[event.key];
  const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (arrow) {
    const [x, y] = arrow;
    if (event.shiftKey) stage.camera.move(-0.04 * x, -0.04 * y);
    else stage.camera.turn(0.08 * x, -0.08 * y);
  } else if (action && objects) action();
  else return;
  event.preventDefault();
  stage.changed();
}

function listen() {
  $("search").addEventListener("submit", (event) => {
    event.preventDefault();
    find($("text").value);
  });
  $("naming").addEventListener("submit", (event) => {
    event.preventDefault();
    nameIt($("its-name").value);
  });
  $("metres").addEventListener("change", () => {
    stage.measure.known(Number($("metres").value));
    measured();
    stage.draw();
  });
  window.addEventListener("hashchange", followed);
  $("modes").addEventListener("change", (event) => stage.setMode(event.target.value));
  $("views").addEventListener("change", () => stage.lookFrom($("views").selectedIndex));
  $("show-cameras").addEventListener("change", cameras);
  $("compare").addEventListener("input", () => setCompare($("compare").value));
  for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);
  document.addEventListener("keydown", pressed);
  stage.measured = measured;
  stage.pickedTogether = (rays) => objects && pickTogether(rays);
  stage.looked = (index) => { $("views").selectedIndex = index; };
  stage.picked = (id) => {
    if (!objects) return;
    queryNumber += 1;
    if (id === 0) return select([]);
    const [only] = state.selected;
    select([state.selected.size === 1 ? objects.below(id, only) : objects.meant(id)]);
  };
}

// Selects the object that several rays of the camera hit.
const pickTogether = withErrors(async (rays) => {
  const number = ++queryNumber;
  const camera = stage.camera.asJson(stage.width, stage.height, ASKED_SIDE);
  const at = ([x, y]) => [Math.floor(x * camera.fx + camera.cx), Math.floor(y * camera.fy + camera.cy)];
  const point = rays.map(at).filter(([x, y]) => x >= 0 && y >= 0 && x < camera.width && y < camera.height);
  const answer = await postJson("/api/query", { point, camera, hidden: [...state.hidden], only: [...state.only] });
  if (number !== queryNumber) return;
  const ids = answer.objects.map((o) => o.id);
  say(`${rays.length} clicks on one object: ${ids.map((id) => `#${id}`).join(", ") || "no object is there"}`);
  select(ids);
});

async function ready() {
  scene = Object.assign(stage.scene, await getJson("/api/scene"));
  objects = new Objects(await getJson("/api/objects"), scene.overlaps ?? [], scene.support_share);
  recent.taught(await getJson("/api/names"));
  $("about").textContent = `${scene.gaussians.toLocaleString("en")} Gaussians, ${scene.objects} objects and parts, ${scene.views.length} views; `
    + `masks: ${scene.segmenter}, embeddings: ${scene.encoder}; rendered by ${stage.renderer.name}, `
    + (scene.shared ? `${scene.shared.words.toLocaleString("en")} words can be queried` : `queries on ${scene.adapter}`);
  $("text").disabled = false;
  update();
  nameObjects();
}

// Loads the likeliest names of the objects. The page works without them: a scene may have no text
// encoder.
async function nameObjects() {
  objects.setNames(await getJson("/api/objects/names").catch(() => []));
  update();
}

async function main() {
  scene = await getJson("/api/scene");
  document.title = `${scene.name} - FastLGS`;
  $("name").textContent = scene.name;
  // A static folder has no exports and no photos.
  $("exports").hidden = Boolean(scene.shared);
  $("compare").hidden = $("photo-label").hidden = !scene.views.some((view) => view.photo);
  stage = new Stage(scene, { stage: $("stage"), canvas: $("canvas"), cameras: $("cameras"), photo: $("photo"), divider: $("divider") }, failed);
  await stage.open(new URLSearchParams(location.search).get("renderer"));
  $("views").replaceChildren(...scene.views.map((view) => new Option(`${view.name}${view.held_out ? " (held out)" : ""}`)));
  recent = new Recent(scene.name, $("recent"));
  listen();
  stage.lookFrom(0);
  if (location.hash) await followed();
  const training = { training: $("training"), text: $("training-text"), loss: $("curve-loss"), psnr: $("curve-psnr") };
  if (scene.stage === "training") {
    $("text").disabled = true;
    await follow(training, () => stage.load());
  }
  // The Gaussians are loaded first; the page can show objects later.
  await stage.load();
  await ready();
  await queryLinkText();
  if (scene.trained_here) await recall(training);
  // For programs that control this page, such as tests.
  window.fastlgs = { stage, state, find };
  document.body.dataset.ready = "true";
}

main().catch((error) => {
  failed(error);
  clearTimeout(failed.timer);
});
