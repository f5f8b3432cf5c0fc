"use strict";
const survey = JSON.parse(document.getElementById("data").textContent);
const columns = survey.columns;
const part = (id) => document.getElementById(id);
const rows = [];
let person = "", order = [], place = 0, named = "", began = 0, saved = true;

function show(section, form) {
  for (const id of ["start", "question", "end"]) part(id).hidden = id !== section;
  if (form) for (const id of ["naming", "rating"]) part(id).hidden = id !== form;
  const heading = part(form || section).querySelector("h1, h2");
  heading.focus();
  scrollTo(0, 0);
}
function shuffled(list) {
  const mixed = list.slice();
  for (let i = mixed.length - 1; i > 0; i--) {
    const j = crypto.getRandomValues(new Uint32Array(1))[0] % (i + 1);
    [mixed[i], mixed[j]] = [mixed[j], mixed[i]];
  }
  return mixed;
}
function showQuestion() {
  const one = order[place];
  part("progress").value = place;
  if (!one) { part("progress").value = place; show("end"); return; }
  part("naming").reset();
  part("rating").reset();
  part("single").src = part("right").src = one.changed;
  part("left").src = one.original || "";
  part("before").hidden = !one.original;
  const [x0, y0, x1, y1] = one.outline.map((value) => 100 * value);
  Object.assign(part("outline").style,
    { left: x0 + "%", top: y0 + "%", width: x1 - x0 + "%", height: y1 - y0 + "%" });
  began = performance.now();
  show("question", "naming");
}
part("begin").addEventListener("submit", (event) => {
  event.preventDefault();
  person = part("name").value.trim();
  if (!person) { part("name").value = ""; part("name").reportValidity(); return; }
  order = shuffled(survey.items);
  saved = false;
  showQuestion();
});
part("naming").addEventListener("submit", (event) => {
  event.preventDefault();
  named = new FormData(event.target).get("named");
  show("question", "rating");
});
part("rating").addEventListener("submit", (event) => {
  event.preventDefault();
  rows.push({ survey: survey.survey, participant: person, item: order[place].item, position: place + 1, named,
    realism: new FormData(event.target).get("realism"), seconds: ((performance.now() - began) / 1000).toFixed(1) });
  place += 1;
  showQuestion();
});
const cell = (value) => /[",\n\r]/.test(value) ? '"' + String(value).replaceAll('"', '""') + '"' : String(value);
part("save").addEventListener("click", () => {
  const lines = [columns, ...rows.map((row) => columns.map((name) => row[name]))];
  const text = lines.map((line) => line.map(cell).join(",")).join("\n") + "\n";
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = "answers-" + person.replace(/[^\p{L}\p{N}]+/gu, "-") + ".csv";
  link.click();
  saved = true;
  part("saved").textContent = "Saved as " + link.download + ".";
});
addEventListener("beforeunload", (event) => { if (!saved) event.preventDefault(); });
show("start");
