"use strict";
const all = (selector, root = document) => [...root.querySelectorAll(selector)];
const one = (selector, root = document) => root.querySelector(selector);
const gallery = one("#gallery");
const number = (element, name) => Number(element.dataset[name]);

// before and after: the slider lies over the picture, so that mouse, finger and arrow keys move the same thing
function cut(slider, percent) {
  slider.value = percent;
  slider.setAttribute("aria-valuetext", `${Math.round(percent)} % of the left picture`);
  slider.closest(".stage").style.setProperty("--cut", `${percent}%`);
}
for (const slider of all(".cut")) slider.addEventListener("input", () => cut(slider, Number(slider.value)));
for (const button of all("button.flip"))
  button.addEventListener("click", () => {
    const slider = one(".cut", button.closest("article"));
    cut(slider, Number(slider.value) > 0 ? 0 : 100);
  });

// which picture is on which side; the photograph (0) shows the boxes of the run beside it
function sides(stage, left, right) {
  for (const layer of all(".layer", stage)) {
    const place = number(layer, "place");
    layer.classList.toggle("left", place === left);
    layer.classList.toggle("right", place === right);
    const run = place ? place - 1 : Math.max((place === left ? right : left) - 1, 0);
    for (const boxes of all(".boxes", layer)) boxes.classList.toggle("on", boxes.dataset.runs.split(" ").includes(String(run)));
  }
  const title = (place) => one(`.layer[data-place="${place}"]`, stage).dataset.title;
  one(".tag.l", stage).textContent = title(left);
  one(".tag.r", stage).textContent = title(right);
  for (const button of all("button.outcome", stage.closest("article")))
    button.setAttribute("aria-pressed", String(number(button, "place") === right));
  for (const shots of all(".close", stage.closest("article"))) shots.classList.toggle("hidden", number(shots, "place") !== right);
}
const left = one("#left"), right = one("#right");
if (left) {
  const both = () => { for (const stage of all(".stage")) sides(stage, Number(left.value), Number(right.value)); };
  left.addEventListener("change", both);
  right.addEventListener("change", both);
  for (const button of all("button.outcome"))
    button.addEventListener("click", () => sides(one(".stage", button.closest("article")), Number(left.value), number(button, "place")));
}
for (const box of all("input[data-show]"))
  box.addEventListener("change", () => gallery.classList.toggle(`show-${box.dataset.show}`, box.checked));

if (matchMedia("(max-width: 40rem)").matches) one("details.tools").open = false; // a screenful on a phone

// filters: a frame is shown where every one that is set agrees; the table follows
const filters = one("#filters");
function wanted(element) {
  const value = (name) => filters.elements[name]?.value ?? "";
  const on = (name) => filters.elements[name]?.checked;
  const failed = on("lost") || on("phantoms");
  return (!failed || (on("lost") && number(element, "lost") > 0) || (on("phantoms") && number(element, "phantoms") > 0)) &&
    number(element, "grade") >= Number(value("grade")) &&
    (!value("param") || element.dataset.params.split(" ").includes(value("param"))) &&
    (!value("weather") || element.dataset.weather === value("weather")) &&
    number(element, "size") <= Number(value("size")) + 1e-9 &&
    element.dataset.name.toLowerCase().includes(value("name").trim().toLowerCase());
}
function filter() {
  for (const element of all("[data-frame]")) element.classList.toggle("hidden", !wanted(element));
  const frames = all("#frames [data-frame]"), kept = frames.filter((row) => !row.classList.contains("hidden")).length;
  one("#count").textContent = `${kept} of ${frames.length} frame${frames.length === 1 ? "" : "s"}`;
  one("#size-now").textContent = Number(filters.elements.size.value) >= Number(filters.elements.size.max) ? "any" : `up to ${filters.elements.size.value} %`;
}
if (filters) {
  filters.addEventListener("input", filter);
  filters.addEventListener("submit", (event) => event.preventDefault());
  filters.querySelector("button[type=reset]").addEventListener("click", (event) => {
    event.preventDefault();  // the fields' own reset comes after the event, and so would be too late to filter by
    filters.reset();
    filter();
    order("rank");
  });
  one("#order").addEventListener("change", (event) => order(event.target.value));
}
function order(key) {
  const compare = key === "name" ? (a, b) => a.dataset.name.localeCompare(b.dataset.name, undefined, { numeric: true })
    : key === "size" ? (a, b) => number(a, "size") - number(b, "size") : (a, b) => number(a, "rank") - number(b, "rank");
  gallery.append(...all("article", gallery).sort(compare));
}

// tables: a click, Enter or Space on a heading sorts by it, and again the other way round
for (const button of all("th button"))
  button.addEventListener("click", () => {
    const heading = button.closest("th"), place = heading.cellIndex, body = one("tbody", heading.closest("table"));
    const up = heading.getAttribute("aria-sort") === "descending" || (!heading.hasAttribute("aria-sort") && heading.classList.contains("words"));
    for (const other of all("th", heading.parentElement)) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = (row) => row.cells[place].dataset.value ?? row.cells[place].textContent.trim();
    const compare = (a, b) => {
      const [x, y] = [key(a), key(b)], [p, q] = [Number.parseFloat(x), Number.parseFloat(y)];
      if (heading.classList.contains("words")) return (up ? 1 : -1) * x.localeCompare(y, undefined, { numeric: true });
      if (Number.isNaN(p) || Number.isNaN(q)) return Number.isNaN(p) - Number.isNaN(q); // nothing to compare: last
      return (up ? 1 : -1) * (p - q);
    };
    body.append(...[...body.rows].sort(compare));
  });
