"use strict";
/* One state, many views of it: sliders, picture, boxes, street, failure map, link, command. What belongs to the state
   is in `values` (by slider, in its unit, zeros left out) and `selection` (car, axes, before); all else follows. */

const $ = id => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const PAGE = Math.random().toString(36).slice(2);
const GROUPS = {translate: "Place", rotate: "Place", size: "Size and shape", shape: "Size and shape", color: "Colour",
  weather: "Weather", foliage: "Leaves", sun: "Sun", lamps: "Lamps"};
const ORDER = ["Place", "Colour", "Size and shape", "Lamps", "Weather", "Leaves", "Sun"];
const MEANING = {along: "forwards, along its photographed heading", across: "to its own left", yaw: "about its ground centre",
  a: "from green to red", b: "from blue to yellow", "lower lightness": "of clothes below the waist",
  "lower a": "of clothes below the waist, from green to red", "lower b": "of clothes below the waist, from blue to yellow", shape: "share of the shape that was found"};
const STATUS = {found: "found", lost: "lost", missed: "missed as photographed too", ignored: "not judged"};

let overview = null, frame = null, values = new Map(), sliders = new Map(), widgets = new Map();
let selection = {car: 0, x: "", y: "", before: false, boxes: true};
let detected = null;          // latest detections
let serial = 1;           // of states: an answer about an earlier one is dropped
let started = 0;          // when the state last changed

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}
function drawing(name, attributes = {}, text = null) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  return made;
}
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const rounded = (value, step) => Number((Math.round(value / step) * step).toFixed(6));
const valueOf = name => values.get(name) ?? 0;

/* ---- asking the server ---------------------------------------------------------------------------------------- */

async function request(path, more = {}) {
  const answer = await fetch(`${path}?${new URLSearchParams(more)}`);
  if (answer.status === 409) return null;
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer;
}
const stateQuery = () => ({...Object.fromEntries(values), frame: frame.name, page: PAGE, n: serial});

function complain(error) {
  toast(error instanceof TypeError ? "no answer: drivesem view has ended" : error.message);
}

/* A loop a kind of answer: one request at a time, and the next is about the state as it is then. pick: another state
   to request, such as one that is drawn already, while the newest is under way. */
function follow(work, pick = () => null) {
  let done = 0, busy = false;
  return async function next() {
    if (busy || frame === null) return;
    busy = true;
    try {
      while (done !== serial) {
        const picked = pick(), state = picked !== null && picked.n > done ? picked : stateQuery();
        await work(state);
        done = state.n;
      }
    } catch (error) {
      done = serial;
      complain(error);
    } finally { busy = false; }
  };
}

let url = "", pictured = null;
const followPicture = follow(async state => {
  const answer = await request("/picture", state);
  if (answer === null) return;
  const next = URL.createObjectURL(await answer.blob()), image = new Image();
  image.src = next;
  await image.decode();
  $("after").src = next;
  if (url) URL.revokeObjectURL(url);
  url = next;
  pictured = state;
  arrived("picture", state.n);
});
const followDetections = follow(async state => {
  const answer = await request("/detections", state);
  if (answer === null) return;
  detected = await answer.json();
  showDetections();
  arrived("detections", state.n);
  if (state.n === serial) settled(serial);
}, () => pictured);
/* Marks, for styles and tests, when the page shows the current state. */
let latest = {};
function arrived(what, now) {
  latest[what] = now;
  $("times").dataset[what] = Math.round(performance.now() - started);
  showTimes();
  if (latest.picture === serial && latest.detections === serial) $("view").dataset.settled = serial;
}
function showTimes() {
  const {picture, detections} = $("times").dataset;
  $("times").textContent = `picture ${picture ?? "–"} ms, detections ${detections ?? "–"} ms`;
}

let resting = 0;
async function settled(now) {
  clearTimeout(resting);
  resting = setTimeout(async () => {
    if (now !== serial) return;
    try {
      const answer = await request("/notes", stateQuery());
      if (answer === null || now !== serial) return;
      const notes = await answer.json();
      $("notes").textContent = notes.length ? `Not possible: ${notes.join("; ")}` : "";
      await fillMap(now);
    } catch (error) { complain(error); }
  }, 120);
}

/* ---- the state ------------------------------------------------------------------------------------------------ */

function changed({keepMap = false} = {}) {
  serial += 1;
  started = performance.now();
  delete $("view").dataset.settled;
  if (!keepMap) forgetMap();
  refresh();
  followPicture();
  followDetections();
}
function refresh() {
  for (const [name, slider] of widgets) slider.show(valueOf(name));
  drawStreet();
  drawMap();
  writeLink();
}
function put(name, value) {
  const slider = sliders.get(name);
  if (slider === undefined) return;
  const clamped = clamp(value, slider.low, slider.high);
  if (clamped === 0) values.delete(name); else values.set(name, clamped);
}
function move(changes, {exact = false} = {}) {
  const before = new Map(values);
  for (const [name, value] of Object.entries(changes)) {
    const slider = sliders.get(name);
    if (slider) put(name, exact ? value : rounded(value, slider.step));
  }
  const names = new Set([...before.keys(), ...values.keys()].filter(n => before.get(n) !== values.get(n)));
  if (names.size) changed({keepMap: [...names].every(n => n === selection.x || n === selection.y)});
}
function become(state) {
  values = new Map();
  for (const [name, value] of Object.entries(state)) put(name, value);
  changed();
}
const named = (car, last) => `objects[${car}].${last}`;

function writeLink() {
  const params = new URLSearchParams({frame: frame.name, car: selection.car, x: selection.x, y: selection.y});
  if (selection.before) params.set("show", "before");
  for (const [name, value] of values) params.set(name, value);
  history.replaceState(null, "", `#${params}`);
}
/* A link's state. Values without any: what the scene holds. */
function readLink() {
  const params = new URLSearchParams(location.hash.slice(1));
  const name = params.get("frame");
  const wanted = {frame: overview.frames.some(f => f.name === name) ? name : overview.frames[0].name, params};
  return wanted;
}
function take(params) {
  const had = params.has("frame");
  const reserved = new Set(["frame", "car", "x", "y", "show"]);
  values = new Map();
  if (had) {
    for (const [name, text] of params) if (!reserved.has(name) && text.trim() !== "" && Number.isFinite(Number(text))) put(name, Number(text));
  } else for (const [name, value] of Object.entries(frame.found)) put(name, value);
  const car = Number(params.get("car") ?? NaN);
  selection.before = params.get("show") === "before";
  choose(Number.isInteger(car) && frame.cars[car] ? car : -1, params.get("x"), params.get("y"), false);
}

/* ---- frames, cars, sliders ------------------------------------------------------------------------------------ */

async function load(name, params) {
  $("words").textContent = "loading";
  const answer = await request("/frame", {frame: name});
  frame = await answer.json();
  sliders = new Map(frame.sliders.map(slider => [slider.name, slider]));
  detected = pictured = null;
  $("title").textContent = [overview.title, overview.detector, frame.change].filter(Boolean).join(" · ");
  $("frame").value = name;
  const where = new URLSearchParams({frame: name});
  $("before").src = `/photograph?${where}`;
  $("boxes").setAttribute("viewBox", `0 0 ${frame.width} ${frame.height}`);
  for (const id of ["after", "before"]) { $(id).setAttribute("width", frame.width); $(id).setAttribute("height", frame.height); }
  $("found").classList.toggle("hidden", Object.keys(frame.found).length === 0);
  $("cars").replaceChildren(...frame.cars.filter(car => carSliders(car.car).length).map(car => {
    const chip = element("button", {type: "button", "data-car": car.car}, element("span", {class: "dot"}), `${car.car} ${car.class}`, element("small", {class: "soft"}));
    chip.addEventListener("click", () => choose(car.car));
    return chip;
  }));
  widgets = new Map();
  fill($("scene-sliders"), frame.sliders.filter(slider => slider.car === null));
  $("street").replaceChildren();
  take(params);
  changed();
}
const carSliders = car => frame.sliders.filter(slider => slider.car === car);
const movable = () => frame.cars.filter(car => carSliders(car.car).length).map(car => car.car);

/* The car that sliders, keys and the map are about; -1: the one to begin with. */
function choose(car, x = null, y = null, redraw = true) {
  if (!movable().includes(car)) car = frame.focus;
  const last = selection.x.startsWith("objects[") ? [selection.x, selection.y].map(n => n.slice(n.indexOf("].") + 2)) : null;
  const axes = frame.sliders.filter(slider => slider.car === null || slider.car === car).map(slider => slider.name);
  const first = [x, last && named(car, last[0]), named(car, "translate.across"), axes[0]].find(n => n && axes.includes(n));
  const second = [y, last && named(car, last[1]), named(car, "translate.along"), ...axes].find(n => n && n !== first && axes.includes(n));
  if (selection.car !== car || selection.x !== first || selection.y !== second || $("map-x").dataset.of !== `${frame.name} ${car}`) {
    selection = {...selection, car, x: first ?? "", y: second ?? ""};
    forgetMap();
    for (const [name] of widgets) if (sliders.get(name)?.car !== null) widgets.delete(name);
    fill($("car-sliders"), carSliders(car), carLine());
    fillAxes(axes);
  }
  if (redraw) { refresh(); showDetections(); settled(serial); }
}
function carLine() {
  if (!frame.cars.length) return element("p", {class: "soft small"}, "The scene has no object that can be moved.");
  const reset = element("button", {type: "button", title: "this object as photographed"}, "reset");
  reset.addEventListener("click", () => restCar());
  return element("p", {class: "chosen-line"}, element("span", {id: "chosen"}), reset);
}
function restCar() {
  move(Object.fromEntries(carSliders(selection.car).map(slider => [slider.name, 0])), {exact: true});
}
function fill(place, list, ...first) {
  const groups = new Map();
  for (const slider of list) {
    const title = GROUPS[slider.group] ?? slider.group;
    if (!groups.has(title)) groups.set(title, []);
    groups.get(title).push(slider);
  }
  const sets = ORDER.filter(title => groups.has(title)).map(title =>
    element("fieldset", {}, element("legend", {}, title), element("div", {}, ...groups.get(title).map(makeSlider))));
  place.replaceChildren(...first, ...sets);
}
function formatValue(slider, value) {
  const digits = slider.unit === "m" || slider.unit === "" ? 2 : 1;
  const text = value.toFixed(digits).replace("-", "−");
  return slider.unit === "" ? text : `${text} ${slider.unit === "deg" ? "°" : slider.unit}`.replace(" °", "°");
}
function makeSlider(slider) {
  const id = `slider-${slider.name}`;
  const input = element("input", {type: "range", id, min: slider.low, max: slider.high, step: "any", "data-name": slider.name});
  const output = element("output", {for: id});
  const back = element("button", {type: "button", title: "as photographed", "aria-label": `${slider.title} as photographed`}, "×");
  const row = element("div", {class: "slider"}, element("label", {for: id, title: MEANING[slider.title] ?? ""}, slider.title), input, output, back);
  input.addEventListener("input", () => move({[slider.name]: Number(input.value)}));
  input.addEventListener("keydown", event => {
    const step = {ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10}[event.key];
    if (step === undefined) return;
    event.preventDefault();
    move({[slider.name]: valueOf(slider.name) + step * slider.step * (event.shiftKey ? 10 : 1)});
  });
  back.addEventListener("click", () => { move({[slider.name]: 0}); input.focus(); });
  widgets.set(slider.name, {show(value) {
    if (Number(input.value) !== value) input.value = value;
    input.setAttribute("aria-valuetext", formatValue(slider, value));
    output.textContent = formatValue(slider, value);
    row.classList.toggle("moved", value !== 0);
  }});
  return row;
}

/* ---- the picture ---------------------------------------------------------------------------------------------- */

function showDetections() {
  const current = selection.before || detected === null ? {boxes: frame.boxes, cars: frame.cars, words: detected?.words, lost: detected?.lost} : detected;
  const rects = [], labels = [];
  for (const mark of current.boxes) {
    const [x0, y0, x1, y1] = mark.xyxy;
    const group = drawing("g", {class: `box ${mark.kind}${mark.car === selection.car ? " chosen" : ""}`});
    for (const ink of ["under", "ink"]) group.append(drawing("rect", {class: ink, x: x0, y: y0, width: Math.max(x1 - x0, 0), height: Math.max(y1 - y0, 0)}));
    if (mark.car !== null) group.addEventListener("click", () => choose(mark.car));
    rects.push(group);
    if (mark.kind === "true" && mark.car !== selection.car) continue;
    if (mark.kind === "ignored" && mark.car !== selection.car) continue;
    const late = x0 > 0.85 * frame.width, low = mark.kind !== "found" && mark.kind !== "phantom";
    const label = element("span", {class: `name-of ${mark.kind}${late ? " late" : ""}${low ? " low" : ""}`}, mark.text);
    label.style.left = `${100 * clamp((late ? x1 : x0) / frame.width, 0, 1)}%`;
    label.style.top = `${100 * clamp((low ? y1 : y0) / frame.height, low ? 0 : .05, low ? .94 : 1)}%`;
    labels.push(label);
  }
  $("boxes").replaceChildren(...rects);
  $("names").replaceChildren(...labels);
  for (const [id, on] of [["after", !selection.before], ["before", selection.before]]) $(id).classList.toggle("hidden", !on);
  $("side").textContent = selection.before ? "photograph" : "after";
  $("flip").setAttribute("aria-pressed", selection.before);
  $("marks").setAttribute("aria-pressed", selection.boxes);
  $("view").classList.toggle("bare", !selection.boxes);
  if (detected === null) return;
  $("words").textContent = detected.words[0].toUpperCase() + detected.words.slice(1);
  $("words").parentElement.classList.toggle("lost", detected.lost + detected.phantoms > 0);
  $("command").textContent = detected.command;
  for (const chip of $("cars").children) {
    const car = Number(chip.dataset.car), status = detected.cars[car].status;
    chip.className = status;
    chip.setAttribute("aria-pressed", car === selection.car);
    chip.title = STATUS[status];
    chip.lastChild.textContent = status === "ignored" ? "" : detected.cars[car].score.toFixed(2);
  }
  const car = detected.cars[selection.car];
  if ($("chosen") && car) $("chosen").textContent = `${selection.car}: ${STATUS[car.status]}, score ${car.score.toFixed(2)} (t* ${frame.t_star.toFixed(2)}, was ${frame.cars[selection.car].score.toFixed(2)})`;
  drawStreet();
}

/* ---- the street from above ------------------------------------------------------------------------------------ */

/* Where a car is: x, z in metres, its heading and its right, as theta moves it from where it was photographed. */
function placed(car) {
  const [cos, sin] = [Math.cos(car.yaw), Math.sin(car.yaw)];
  const along = valueOf(named(car.car, "translate.along")), across = valueOf(named(car.car, "translate.across"));
  const yaw = car.yaw + valueOf(named(car.car, "yaw")) * Math.PI / 180;
  return {x: car.x + along * cos + across * sin, z: car.z - along * sin + across * cos, yaw,
    grown: 1 + valueOf(named(car.car, "size")) / 100};
}
function corners(x, z, yaw, length, width) {
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([a, b]) => {
    const [l, w] = [a * length / 2, b * width / 2];
    return `${(x + l * cos + w * sin).toFixed(3)},${-(z - l * sin + w * cos).toFixed(3)}`;
  }).join(" ");
}
let dragged = null;
function drawStreet() {
  if (frame === null) return;
  const {x0, x1, z0, z1} = frame.street, svg = $("street");
  svg.setAttribute("viewBox", `${x0} ${-z1} ${x1 - x0} ${z1 + 1}`);
  if (!svg.firstChild) {
    svg.append(drawing("image", {class: "ground", href: `/street?${new URLSearchParams({frame: frame.name})}`, x: x0, y: -z1, width: x1 - x0, height: z1 - z0, preserveAspectRatio: "none"}));
    for (let r = 10; r <= z1; r += z1 > 45 ? 20 : 10) {
      svg.append(drawing("circle", {class: "ring", cx: 0, cy: 0, r}));
      const x = -Math.min(.62 * r, x1 - 2), y = -Math.sqrt(r * r - x * x);
      svg.append(drawing("text", {class: "far", x, y: y - .3, "font-size": Math.max(.9, (z1 + 1) / 36)}, `${r} m`));
    }
    svg.append(drawing("path", {class: "camera", d: "M-.9 .9L0 -.6L.9 .9Z"}));
    svg.append(drawing("g", {id: "cars-above"}));
  }
  const status = car => (detected ?? frame).cars[car].status;
  const parts = [];
  const chosen = frame.cars[selection.car];
  if (chosen && movable().includes(selection.car)) {
    parts.push(reachOf(chosen));
    for (const car of frame.cars.filter(c => movable().includes(c.car)))
      parts.push(drawing("polygon", {class: "was", points: corners(car.x, car.z, car.yaw, car.length, car.width)}));
  }
  const size = Math.max(1.1, (z1 + 1) / 30);
  for (const car of frame.cars.filter(c => movable().includes(c.car))) {
    const here = placed(car), length = car.length * here.grown, width = car.width * here.grown;
    const group = drawing("g", {class: `car ${status(car.car)}${car.car === selection.car ? " chosen" : ""}`, "data-car": car.car});
    group.append(drawing("title", {}, `${car.class} ${car.car}: ${STATUS[status(car.car)]}`));
    group.append(drawing("polygon", {class: "body", points: corners(here.x, here.z, here.yaw, length, width)}));
    const [cos, sin] = [Math.cos(here.yaw), Math.sin(here.yaw)], nose = .34 * length;
    group.append(drawing("polygon", {class: "nose", points: corners(here.x + nose * cos, here.z - nose * sin, here.yaw, .1 * length, .8 * width)}));
    group.append(drawing("text", {x: here.x, y: -here.z, "font-size": size}, car.car));
    parts.push(group);
    if (car.car === selection.car && sliders.has(named(car.car, "yaw"))) {
      const far = .5 * length + 1.6, at = {x: here.x + far * cos, z: here.z - far * sin};
      parts.push(drawing("line", {class: "stick", x1: here.x + .5 * length * cos, y1: -(here.z - .5 * length * sin), x2: at.x, y2: -at.z}));
      parts.push(drawing("circle", {class: "turn", cx: at.x, cy: -at.z, r: .62, "data-car": car.car}));
    }
  }
  $("cars-above").replaceChildren(...parts);
}
function reachOf(car) {
  const along = sliders.get(named(car.car, "translate.along")), across = sliders.get(named(car.car, "translate.across"));
  if (!along || !across) return drawing("g");
  const [cos, sin] = [Math.cos(car.yaw), Math.sin(car.yaw)];
  const points = [[along.low, across.low], [along.high, across.low], [along.high, across.high], [along.low, across.high]];
  return drawing("polygon", {class: "reach", points: points.map(([a, b]) => `${car.x + a * cos + b * sin},${-(car.z - a * sin + b * cos)}`).join(" ")});
}
function metres(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform($("street").getScreenCTM().inverse());
  return {x: point.x, z: -point.y};
}
$("street").addEventListener("pointerdown", event => {
  const grip = event.target.closest("[data-car]");
  if (!grip) return;
  event.preventDefault();
  const car = Number(grip.dataset.car);
  if (car !== selection.car) choose(car);
  const at = metres(event), here = placed(frame.cars[car]);
  dragged = {car, turns: grip.classList.contains("turn"), dx: at.x - here.x, dz: at.z - here.z};
  $("street").setPointerCapture(event.pointerId);
});
$("street").addEventListener("pointermove", event => {
  if (!dragged) return;
  const car = frame.cars[dragged.car], at = metres(event), [cos, sin] = [Math.cos(car.yaw), Math.sin(car.yaw)];
  if (dragged.turns) {
    const here = placed(car), yaw = Math.atan2(-(at.z - here.z), at.x - here.x);
    const turn = Math.atan2(Math.sin(yaw - car.yaw), Math.cos(yaw - car.yaw));
    move({[named(dragged.car, "yaw")]: turn * 180 / Math.PI});
  } else {
    const dx = at.x - dragged.dx - car.x, dz = at.z - dragged.dz - car.z;
    move({[named(dragged.car, "translate.along")]: dx * cos - dz * sin, [named(dragged.car, "translate.across")]: dx * sin + dz * cos});
  }
});
for (const name of ["pointerup", "pointercancel"]) $("street").addEventListener(name, () => { dragged = null; });

/* ---- the failure map ------------------------------------------------------------------------------------------ */

let map = {cells: new Map(), run: 0};
function forgetMap() { map = {cells: new Map(), run: map.run + 1}; }
function fillAxes(axes) {
  for (const [id, of] of [["map-x", "x"], ["map-y", "y"]]) {
    $(id).replaceChildren(...axes.map(name => {
      const slider = sliders.get(name);
      const title = `${GROUPS[slider.group].toLowerCase()}: ${slider.title}`;
      return element("option", {value: name}, title);
    }));
    $(id).value = selection[of];
    $(id).dataset.of = `${frame.name} ${selection.car}`;
  }
  const car = frame.cars[selection.car];
  $("map-car").textContent = car ? `${car.class} ${selection.car}` : "";
}
for (const [id, of, other] of [["map-x", "x", "y"], ["map-y", "y", "x"]]) $(id).addEventListener("change", event => {
  const before = selection[of];
  selection[of] = event.target.value;
  if (selection.x === selection.y) { selection[other] = before; $(`map-${other}`).value = before; }
  forgetMap();
  refresh();
  settled(serial);
});
const at = (slider, i) => slider.low + (slider.high - slider.low) * i / (overview.grid - 1);
/* Every other cell first: a rough map soon, a fine one a little later. */
function order() {
  const all = [];
  for (let i = 0; i < overview.grid; i++) for (let j = 0; j < overview.grid; j++) all.push([i, j, (i % 4 === 0) && (j % 4 === 0) ? 0 : (i % 2 === 0) && (j % 2 === 0) ? 1 : 2]);
  return all.sort((a, b) => a[2] - b[2]);
}
async function fillMap(now) {
  const x = sliders.get(selection.x), y = sliders.get(selection.y), mine = map, car = selection.car;
  if (!x || !y || !movable().includes(car) || document.hidden) return;
  for (const [i, j] of order()) {
    if (mine !== map || now !== serial) return;
    if (mine.cells.has(`${i} ${j}`)) continue;
    const state = {...stateQuery(), [x.name]: rounded(at(x, i), 1e-6), [y.name]: rounded(at(y, j), 1e-6), car};
    const answer = await request("/score", state);
    if (answer === null || mine !== map) return;
    mine.cells.set(`${i} ${j}`, await answer.json());
    drawMap();
  }
}
/* From pale to deep blue with the score; what is not found is orange and crossed. */
function colour(cell) {
  if (cell.status === "lost" || cell.status === "missed") return "var(--lost)";
  if (cell.status === "ignored") return "var(--line)";
  const share = clamp((cell.score - frame.t_star) / (1 - frame.t_star), 0, 1);
  return `color-mix(in oklab, #08306b ${Math.round(100 * share)}%, #c9def2)`;
}
function nearest(i, j) {
  for (const step of [1, 2, 4]) {
    const cell = map.cells.get(`${Math.round(i / step) * step} ${Math.round(j / step) * step}`);
    if (cell) return [cell, step > 1];
  }
  return [null, false];
}
function drawMap() {
  const x = sliders.get(selection.x), y = sliders.get(selection.y), svg = $("map");
  const [width, height] = [400, 330], [left, bottom, top, right] = [52, 42, 6, 8];
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  if (!x || !y) { svg.replaceChildren(); return; }
  const w = (width - left - right) / overview.grid, h = (height - top - bottom) / overview.grid, parts = [];
  for (let i = 0; i < overview.grid; i++) for (let j = 0; j < overview.grid; j++) {
    const [cell, rough] = nearest(i, j), px = left + i * w, py = height - bottom - (j + 1) * h;
    const rect = drawing("rect", {class: `cell ${cell ? cell.status : "waits"}${rough ? " rough" : ""}`, x: px, y: py, width: w, height: h, "data-i": i, "data-j": j});
    if (cell) {
      rect.setAttribute("fill", colour(cell));
      rect.append(drawing("title", {}, `${formatValue(x, at(x, i))}, ${formatValue(y, at(y, j))}: ${STATUS[cell.status]}, score ${cell.score.toFixed(2)}`));
    }
    parts.push(rect);
    if (cell && !rough && (cell.status === "lost" || cell.status === "missed"))
      parts.push(drawing("path", {class: "cross", d: `M${px + .3 * w} ${py + .3 * h}l${.4 * w} ${.4 * h}m0 ${-.4 * h}l${-.4 * w} ${.4 * h}`}));
  }
  const place = (slider, value, from, size) => from + size / 2 + (value - slider.low) / (slider.high - slider.low) * (overview.grid - 1) * size;
  const zeroX = place(x, 0, left, w), zeroY = height - bottom - place(y, 0, 0, h);
  if (x.low <= 0 && x.high >= 0) parts.push(drawing("line", {class: "zero", x1: zeroX, x2: zeroX, y1: top, y2: height - bottom}));
  if (y.low <= 0 && y.high >= 0) parts.push(drawing("line", {class: "zero", x1: left, x2: width - right, y1: zeroY, y2: zeroY}));
  const cx = place(x, valueOf(x.name), left, w), cy = height - bottom - place(y, valueOf(y.name), 0, h);
  for (const name of ["under-here", "here"]) parts.push(drawing("circle", {class: name, cx, cy, r: 7}));
  for (const [value, px, anchor] of [[x.low, left + w / 2, "middle"], [x.high, width - right - w / 2, "middle"]])
    parts.push(drawing("text", {x: px, y: height - bottom + 15, "text-anchor": anchor}, formatValue(x, value)));
  for (const [value, py] of [[y.low, height - bottom - h / 2], [y.high, top + h / 2]])
    parts.push(drawing("text", {x: left - 5, y: py + 4, "text-anchor": "end"}, formatValue(y, value)));
  parts.push(drawing("text", {class: "axis", x: left + (width - left - right) / 2, y: height - 8, "text-anchor": "middle"}, `${x.title} →`));
  parts.push(drawing("text", {class: "axis", x: 0, y: 0, "text-anchor": "middle", transform: `translate(13 ${top + (height - top - bottom) / 2}) rotate(-90)`}, `${y.title} →`));
  svg.replaceChildren(...parts);
  const cells = [...map.cells.values()], lost = cells.filter(c => c.status === "lost" || c.status === "missed").length;
  const none = !movable().includes(selection.car);
  $("map-status").textContent = none ? "no object selected" : `${lost} of ${cells.length} not found${cells.length < overview.grid * overview.grid ? ", in progress" : ""}`;
  $("map").dataset.cells = cells.length;
}
let aiming = false;
function aim(event) {
  const target = document.elementFromPoint(event.clientX, event.clientY)?.closest("#map .cell");
  if (!target) return;
  const x = sliders.get(selection.x), y = sliders.get(selection.y);
  move({[x.name]: at(x, Number(target.dataset.i)), [y.name]: at(y, Number(target.dataset.j))});
}
$("map").addEventListener("pointerdown", event => { aiming = true; aim(event); });
$("map").addEventListener("pointermove", event => { if (aiming) aim(event); });
for (const name of ["pointerup", "pointercancel", "pointerleave"]) $("map").addEventListener(name, () => { aiming = false; });
function drawRamp() {
  const svg = drawing("svg", {viewBox: "0 0 90 9", preserveAspectRatio: "none"});
  for (let i = 0; i < 12; i++) svg.append(drawing("rect", {x: i * 7.5, y: 0, width: 7.6, height: 9, fill: colour({status: "found", score: frame.t_star + (1 - frame.t_star) * i / 11})}));
  const lost = drawing("svg", {viewBox: "0 0 9 9"});
  lost.style.width = "1rem";
  lost.append(drawing("rect", {width: 9, height: 9, fill: "var(--lost)"}), drawing("path", {d: "M2.5 2.5l4 4m0 -4l-4 4", stroke: "#000"}));
  $("ramp").replaceChildren(frame.t_star.toFixed(2), svg, "1 ", lost, " not found");
}

/* ---- acts and keys -------------------------------------------------------------------------------------------- */

let fading = 0;
function toast(text) {
  $("toast").textContent = text;
  clearTimeout(fading);
  fading = setTimeout(() => { $("toast").textContent = ""; }, 3500);
}
async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    toast(`${what} copied`);
  } catch {
    getSelection().selectAllChildren($("command"));
    toast("select and copy it by hand: this browser does not let pages copy");
  }
}
function flip() { selection.before = !selection.before; showDetections(); writeLink(); }
function nextCar(step) {
  const all = movable();
  if (all.length) choose(all[(all.indexOf(selection.car) + step + all.length) % all.length]);
}
function nudge(last, sign, event) {
  const slider = sliders.get(named(selection.car, last)), step = {m: .05, deg: .5}[slider?.unit] ?? 0;
  if (slider) move({[slider.name]: valueOf(slider.name) + sign * step * (event.shiftKey ? 10 : 1)});
}
const copyCommand = () => copy($("command").textContent, "Command"), copyLink = () => copy(location.href, "Link");
function showKeys() {
  const off = $("keys").classList.toggle("hidden");
  $("show-keys").setAttribute("aria-expanded", !off);
}
/* Arrows as one sees them: to the right and away; which of its axes that is depends on how the car stands. */
function push(right, away, event) {
  const car = frame.cars[selection.car];
  if (!car) return;
  const [cos, sin] = [Math.cos(car.yaw), Math.sin(car.yaw)];
  const along = right * cos - away * sin, across = right * sin + away * cos;
  if (Math.abs(along) >= Math.abs(across)) nudge("translate.along", Math.sign(along), event);
  else nudge("translate.across", Math.sign(across), event);
}
const KEYS = {
  b: flip, d: () => { selection.boxes = !selection.boxes; showDetections(); }, n: () => nextCar(1), p: () => nextCar(-1), r: restCar,
  0: () => become({}), f: () => become(frame.found), c: copyCommand, l: copyLink, "?": showKeys,
  arrowup: e => push(0, 1, e), arrowdown: e => push(0, -1, e), arrowright: e => push(1, 0, e), arrowleft: e => push(-1, 0, e),
  q: e => nudge("yaw", -1, e), e: e => nudge("yaw", 1, e),
};
document.addEventListener("keydown", event => {
  const act = KEYS[event.key.toLowerCase()];
  const typing = event.target.matches("select, input") && (event.target.matches("select") || event.key.startsWith("Arrow"));
  if (!act || frame === null || typing || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  act(event);
});
for (const [id, act] of [["flip", flip], ["marks", KEYS.d], ["rest", KEYS[0]], ["found", KEYS.f], ["copy-link", copyLink],
  ["copy-command", copyCommand], ["show-keys", showKeys]]) $(id).addEventListener("click", act);
$("frame").addEventListener("change", event => load(event.target.value, new URLSearchParams()).catch(complain));
addEventListener("hashchange", () => {
  const {frame: name, params} = readLink();
  if (name !== frame?.name) load(name, params).catch(complain);
  else { take(params); changed(); showDetections(); }
});
document.addEventListener("visibilitychange", () => { if (!document.hidden && frame) settled(serial); });

(async () => {
  overview = await (await request("/overview")).json();
  document.title = `${overview.title} - drivesem view`;
  $("frame").replaceChildren(...overview.frames.map(({name, words: summary}) => element("option", {value: name}, summary ? `${name} (${summary})` : name)));
  const {frame: name, params} = readLink();
  await load(name, params);
  drawRamp();
  $("searched").innerHTML = await (await request("/searched")).text();  // names in it are escaped
  $("searched-part").classList.toggle("hidden", $("searched").childElementCount === 0);
})().catch(complain);
