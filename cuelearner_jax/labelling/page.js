// Keys, buttons and pointing. Each answer names the item on the screen. Films move the sketch's movers.
//
// A press before a question can be answered is ignored, counted and reported. It is never queued, since it would then
// answer a question that nobody has seen. So the presses made are the answers saved plus the presses reported.
"use strict";
const SOON = 100;  // within this time of a question's appearance nobody can have read it and answered [ms]
const TWICE = 400;  // longest time between the clicks of a double click [ms]
const cue = {
  keys: {}, again: "", item: undefined, shown: Infinity, sent: false, dropped: 0, playing: 0,
  scene() { return document.querySelector("svg.scene"); },
  at() { const scene = cue.scene(); return scene ? +scene.dataset.item : null; },
  window() { return document.querySelector(".q-dialog"); },
  seconds() { return Math.max(performance.now() - cue.shown, 0) / 1000; },
  why(clicks) {  // the reason why no answer is possible now; empty if one is
    const since = performance.now() - cue.shown;
    if (cue.window()) return "a window lies over the question: close it first";
    if (cue.sent || cue.item !== cue.at()) return "the next question was not there yet";
    if (!(since >= SOON)) return "the question had only just come";
    if (clicks > 1 && since < TWICE) return "it was the second click of a double click";
    return "";
  },
  ready() { return !cue.why(1); },
  send(name, told = {}) {
    if (name === "help") { emitEvent("cue", {name}); return; }
    if (name.startsWith("film")) { if (cue.scene()) emitEvent("cue", {name, item: cue.at()}); return; }
    const why = cue.why(told.clicks || 1);
    if (why) { cue.drop(why); return; }
    if (!cue.scene() && name !== "undo") return;
    if (name.startsWith("pick")) { emitEvent("cue", {name, item: cue.at()}); return; }  // a part of the answer, about one of several cues
    cue.sent = true;
    cue.tell("");
    emitEvent("cue", {name, item: cue.at(), angle: told.angle === undefined ? null : told.angle, seconds: cue.seconds()});
  },
  tell(why) {
    const line = document.querySelector(".dropped");
    if (!line) return;
    const count = cue.dropped === 1 ? "1 press was not taken" : `${cue.dropped} presses were not taken`;
    line.textContent = why ? `Not taken: ${why}. So far ${count}.` : cue.dropped ? `So far ${count}.` : "";
    line.classList.toggle("now", !!why);
  },
  drop(why) { cue.dropped += 1; cue.tell(why); },
  mark(names) {  // highlight in the picture the parts chosen so far
    document.querySelectorAll("svg.scene .said").forEach(
      said => said.classList.toggle("picked", names.includes(said.dataset.name)));
  },
  refused(why) { cue.sent = false; cue.drop(why); },  // by the server
  angle(event) {
    const scene = cue.scene();
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(scene.getScreenCTM().inverse());
    const [x, y] = JSON.parse(scene.dataset.foot);
    return Math.atan2(y - at.y, at.x - x) * 180 / Math.PI - +scene.dataset.turn;
  },
  point(event) {
    const pointer = cue.scene() && cue.scene().querySelector(".pointer");
    if (!pointer) return;
    const scene = cue.scene(), [x, y] = JSON.parse(scene.dataset.foot);
    pointer.setAttribute("transform", `rotate(${+scene.dataset.angle - cue.angle(event)} ${x} ${y})`);
  },
  place(mover, at) {
    mover.style.visibility = at ? "visible" : "hidden";
    if (at) mover.setAttribute("transform", `translate(${at[0]} ${at[1]}) rotate(${at[2]})`);
  },
  photos(scene, film) {  // show a film's pictures over the scene's; decoded beforehand, to avoid flicker
    const photo = scene.querySelector("image.photo");
    scene.querySelectorAll("image.frame").forEach(one => one.remove());
    if (!photo) return [];
    return film.pictures.map(picture => {
      const frame = photo.cloneNode();
      frame.setAttribute("class", "frame");
      frame.setAttribute("href", picture);
      frame.style.visibility = "hidden";
      photo.parentNode.append(frame);
      return frame;
    });
  },
  async play(film) {
    const scene = cue.scene();
    if (!scene || +scene.dataset.item !== film.item) return;
    const movers = Object.fromEntries([...scene.querySelectorAll(".mover")].map(one => [one.dataset.mover, one]));
    const run = ++cue.playing, photos = cue.photos(scene, film);
    const show = (places, at) => {
      Object.entries(movers).forEach(([name, mover]) => cue.place(mover, places[name]));
      photos.forEach((photo, number) => { photo.style.visibility = number === at ? "visible" : "hidden"; });
    };
    await Promise.all(photos.map(photo => photo.decode && photo.decode().catch(() => {})));
    const start = performance.now(), last = Math.max(film.frames.length, photos.length) - 1;
    const words = document.querySelector(".film-words");
    if (words) words.textContent = "";
    const tick = now => {
      if (run !== cue.playing || !scene.isConnected) return;
      const at = Math.floor((now - start) / 1000 / film.period), frame = Math.max(0, Math.min(at, last));
      show(film.frames[frame] || {}, frame);
      if (at >= last && words) words.textContent = film.words;
      if (at * film.period < last * film.period + 1.0) { requestAnimationFrame(tick); return; }
      show(JSON.parse(scene.dataset.places), -1);
    };
    requestAnimationFrame(tick);
  },
  gone() {  // contents of NiceGUI's notice of a lost connection
    const popup = document.getElementById("popup");
    if (!popup) return;
    const line = (kind, text) => popup.append(Object.assign(document.createElement(kind), {textContent: text}));
    popup.replaceChildren();
    line("span", "The command behind this page has stopped.");
    line("div", "Every answer that the page counted is saved. To go on, type in the terminal");
    line("code", cue.again);
    line("div", "and open the address that it prints: this tab does not know it.");
  },
};
window.cue = cue;
new MutationObserver(() => {
  if (cue.at() === cue.item) return;  // the same question, with a newer model's correction
  cue.item = cue.at();
  cue.sent = false;
  cue.shown = Infinity;
  const words = document.querySelector(".film-words");
  if (words) words.textContent = "";
  requestAnimationFrame(() => { cue.shown = performance.now(); });
}).observe(document, {childList: true, subtree: true});
document.addEventListener("DOMContentLoaded", () => cue.gone());
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const name = cue.keys[event.key];
  if (!name) return;
  if (cue.window() && (["Enter", " "].includes(event.key) || name === "undo")) return;  // keys for the open window
  event.preventDefault();
  if (!event.repeat) cue.send(name);
});
document.addEventListener("click", event => {
  if (document.activeElement && document.activeElement.blur) document.activeElement.blur();
  const scene = event.target.closest && event.target.closest("svg.scene"), said = event.target.closest(".said");
  if (scene && said) { cue.send(said.dataset.name, {clicks: event.detail}); return; }
  if (scene && +scene.dataset.points) cue.send("point", {angle: cue.angle(event), clicks: event.detail});
});
document.addEventListener("pointermove", event => {
  if (cue.scene() && +cue.scene().dataset.points) cue.point(event);
});
