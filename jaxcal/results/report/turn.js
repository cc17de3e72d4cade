// Turns the drawings of the class "turnable" under the mouse, a finger, or the arrow keys.
(function () {
  "use strict";
  function turnable(svg) {
    const first = { yaw: Number(svg.dataset.yaw), pitch: Number(svg.dataset.pitch) };
    const view = { yaw: first.yaw, pitch: first.pitch };
    const box = svg.viewBox.baseVal;
    const places = (text) => text.split(" ").map((point) => point.split(",").map(Number));
    const parts = Array.from(svg.querySelectorAll("[data-space]"), (element) => ({
      element: element,
      points: places(element.dataset.space),
    }));
    function draw() {
      const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
      for (const part of parts) {
        const page = part.points.map(([x, y, z]) => [
          box.width / 2 + cy * x + sy * z,
          box.height / 2 + sp * sy * x + cp * y - sp * cy * z,
        ]);
        if (part.element.tagName === "text") {
          part.element.setAttribute("x", page[0][0].toFixed(1));
          part.element.setAttribute("y", page[0][1].toFixed(1));
        } else {
          part.element.setAttribute("points", page.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "));
        }
      }
    }
    function turn(right, down) {
      view.yaw += 0.01 * right;
      view.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, view.pitch + 0.01 * down));
      draw();
    }
    let last = null;
    svg.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      try { svg.setPointerCapture(event.pointerId); } catch (error) { /* the pointer is gone already */ }
    });
    svg.addEventListener("pointermove", (event) => {
      if (last === null) return;
      turn(event.clientX - last[0], event.clientY - last[1]);
      last = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => { last = null; });
    svg.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, -10], ArrowDown: [0, 10] };
      if (!(event.key in steps)) return;
      event.preventDefault();
      turn(...steps[event.key]);
    });
    svg.addEventListener("dblclick", () => { Object.assign(view, first); draw(); });
  }
  document.querySelectorAll("svg.turnable").forEach(turnable);
})();
