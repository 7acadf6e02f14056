"use strict";
// Shared by the pages of `sphereorient mark`: a picture on a canvas, and requests to the server.
const $ = id => document.getElementById(id), canvas = $("canvas"), context = canvas.getContext("2d");
let shown = null, zoom = 1, left = 0, up = 0;  // shown: { width, height } of the picture; each page has a draw()

const at = path => path.split("/").map(encodeURIComponent).join("/");
function say(text, bad = false) { $("said").textContent = text; $("said").className = bad ? "bad" : ""; }
async function get(path, options) {
  const answer = await fetch(at(path), options);
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error);
  return content;
}
function load(path) {
  return new Promise((done, failed) => {
    const image = new Image();
    image.onload = () => done(image);
    image.onerror = () => failed(new Error("this picture cannot be decoded"));
    image.src = at(path) + "?" + Math.random();
  });
}
function fit() {
  const scale = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  canvas.width = Math.round(box.width * scale); canvas.height = Math.round(box.height * scale);
  if (!shown) return;
  zoom = Math.min(canvas.width / shown.width, canvas.height / shown.height);
  left = (canvas.width - zoom * shown.width) / 2; up = (canvas.height - zoom * shown.height) / 2;
  draw();
}
// Pixel centres are whole numbers: the corner of the first pixel is at -0.5.
const toPage = (u, v) => [left + zoom * (u + .5), up + zoom * (v + .5)];
function fromEvent(event) {
  const box = canvas.getBoundingClientRect(), scale = canvas.width / box.width;
  return [((event.clientX - box.left) * scale - left) / zoom - .5, ((event.clientY - box.top) * scale - up) / zoom - .5];
}
canvas.onwheel = event => {  // zoom about the mouse
  event.preventDefault();
  if (!shown) return;
  const [u, v] = fromEvent(event), least = Math.min(canvas.width / shown.width, canvas.height / shown.height);
  const next = Math.min(zoom * 1.2 ** -Math.sign(event.deltaY), 40 * least);
  if (next <= least) { fit(); return; }
  left += (zoom - next) * (u + .5); up += (zoom - next) * (v + .5); zoom = next;
  draw();
};
const place = () => [left, up, zoom * shown.width, zoom * shown.height];
function clear() {
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.imageSmoothingEnabled = false;
  context.lineWidth = 2 * (window.devicePixelRatio || 1);
}
window.onresize = fit;
