// Keys, buttons and pointing; each answer names the item that is on the screen. Films move what can move.
"use strict";
const cue = {
  keys: {}, shown: performance.now(), sent: null, playing: 0,
  scene() { return document.querySelector("svg.scene"); },
  seconds() { return (performance.now() - cue.shown) / 1000; },
  send(name, angle) {
    const scene = cue.scene();
    if (name === "help") { emitEvent("cue", {name}); return; }
    if (!scene && name !== "undo") return;
    const item = scene ? +scene.dataset.item : null;
    const film = name.startsWith("film");
    const now = performance.now();
    // One answer for what is on the screen; if the server stays silent, it may be said again: it keeps one alone.
    if (!film && cue.sent && cue.sent.scene === scene && now - cue.sent.at < 1000) return;
    if (!film) cue.sent = {scene, at: now};
    emitEvent("cue", {name, item, angle: angle === undefined ? null : angle, seconds: cue.seconds()});
  },
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
  play(film) {
    const scene = cue.scene();
    if (!scene || +scene.dataset.item !== film.item) return;
    const movers = Object.fromEntries([...scene.querySelectorAll(".mover")].map(one => [one.dataset.mover, one]));
    const show = places => Object.entries(movers).forEach(([name, mover]) => cue.place(mover, places[name]));
    const run = ++cue.playing, start = performance.now(), last = film.frames.length - 1;
    const words = document.querySelector(".film-words");
    if (words) words.textContent = "";
    const tick = now => {
      if (run !== cue.playing || !scene.isConnected) return;
      const at = Math.floor((now - start) / 1000 / film.period);
      show(film.frames[Math.max(0, Math.min(at, last))]);
      if (at >= last && words) words.textContent = film.words;
      if (at * film.period < last * film.period + 1.0) requestAnimationFrame(tick);
      else show(JSON.parse(scene.dataset.places));
    };
    requestAnimationFrame(tick);
  },
};
window.cue = cue;
new MutationObserver(() => {
  if (cue.scene() === cue.last) return;
  cue.last = cue.scene();
  cue.sent = null;
  const words = document.querySelector(".film-words");
  if (words) words.textContent = "";
  requestAnimationFrame(() => { cue.shown = performance.now(); });
}).observe(document, {childList: true, subtree: true});
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const name = cue.keys[event.key];
  if (!name) return;
  event.preventDefault();
  if (!event.repeat) cue.send(name);
});
document.addEventListener("click", event => {
  if (document.activeElement && document.activeElement.blur) document.activeElement.blur();
  const scene = event.target.closest && event.target.closest("svg.scene");
  if (scene && +scene.dataset.points) cue.send("point", cue.angle(event));
});
document.addEventListener("pointermove", event => {
  if (cue.scene() && +cue.scene().dataset.points) cue.point(event);
});
