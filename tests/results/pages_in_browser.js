// Looks at pages in frames of several widths and writes what it saw into the document, as JSON.
const seen = [];
function look(frame) {
  const page = frame.contentDocument, window_ = frame.contentWindow;
  const plots = Array.from(page.querySelectorAll("figure.plot > svg"));
  const empty = plots.filter((svg) => {
    const box = svg.getBoundingClientRect(), drawn = svg.getBBox();
    return !(box.width > 100 && box.height > 100 && drawn.width > 0 && drawn.height > 0);
  });
  const pictures = Array.from(page.querySelectorAll("figure.frame svg"));
  const small = pictures.filter((svg) => svg.getBoundingClientRect().width < 100);
  const scene = page.querySelector("svg.turnable");
  seen.push({
    name: frame.name,
    errors: window_.errors,
    plots: plots.length,
    empty: empty.map((svg) => svg.parentElement.querySelector("h4").textContent),
    small: small.length,
    overflow: page.documentElement.scrollWidth - window_.innerWidth,
    scene: scene === null ? null : turn(scene, window_),
  });
}
// What the lines of the rig are after each thing a mouse or a key does to it.
function turn(scene, window_) {
  const places = () => Array.from(scene.querySelectorAll("polyline"), (line) => line.getAttribute("points")).join(";");
  const mouse = (kind, x, y) =>
    scene.dispatchEvent(new window_.PointerEvent(kind, { clientX: x, clientY: y, pointerId: 1, bubbles: true }));
  const before = places();
  mouse("pointerdown", 100, 100);
  mouse("pointermove", 130, 110);
  const turned = places();
  mouse("pointerup", 130, 110);
  mouse("pointermove", 200, 200);
  const released = places();
  scene.dispatchEvent(new window_.KeyboardEvent("keydown", { key: "ArrowLeft", bubbles: true }));
  const keyed = places();
  scene.dispatchEvent(new window_.MouseEvent("dblclick", { bubbles: true }));
  const back = places();
  return { before: before, turned: turned, released: released, keyed: keyed, back: back };
}
window.addEventListener("load", () => {
  for (const frame of document.querySelectorAll("iframe")) {
    try { look(frame); } catch (error) { seen.push({ name: frame.name, errors: [String(error)] }); }
  }
  const out = document.createElement("pre");
  out.id = "seen";
  out.textContent = JSON.stringify(seen);
  document.body.replaceChildren(out);
});
