"use strict";
const frames = JSON.parse(document.getElementById("data").textContent);
const part = (id) => document.getElementById(id);
const slider = part("frame"), play = part("play");
let timer = 0;

function show(number) {
  slider.value = number;
  for (const side of ["before", "after"]) part(side).src = frames[number][side];
  part("name").textContent = frames[number].name;
  slider.setAttribute("aria-valuetext", frames[number].name);
  part("strips").style.setProperty("--now", `${(100 * (number + .5)) / frames.length}%`);
}
function playing(on) {
  clearInterval(timer);
  timer = on ? setInterval(() => show((Number(slider.value) + 1) % frames.length), 100) : 0;
  play.textContent = on ? "stop" : "play";
  play.setAttribute("aria-pressed", String(on));
}
slider.addEventListener("input", () => { playing(false); show(Number(slider.value)); });
play.addEventListener("click", () => playing(!timer));
part("strips").addEventListener("click", (event) => {
  const strip = event.target.closest(".strip");
  if (!strip) return;
  const { left, width } = strip.getBoundingClientRect();
  playing(false);
  show(Math.min(Math.floor(((event.clientX - left) / width) * frames.length), frames.length - 1));
});
for (const one of frames) for (const side of ["before", "after"]) new Image().src = one[side];
show(0);
