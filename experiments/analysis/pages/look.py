"""What the page looks like, and what it does: a style sheet and a script, both part of the page."""

COLOURS = """
:root{--ink:#1d2126;--soft:#59616b;--paper:#fff;--rim:#d5dae0;--grid:#e6e9ed;--other:#c3c9d0;--link:#0b5cad;
--c0:#0072b2;--c1:#c94f00;--c2:#00805c;--c3:#b0487f;--c4:#946200;--c5:#2585bd;--c6:#222;
--yes:#00694b;--no:#a63a00;--open:#5c4a9c;--wall:#c9ced4;
--v1:#d6e6f4;--v2:#abcfe6;--v3:#74b0d8;--v4:#3f8cc4;--v5:#1b65a6;--v6:#083b73}
@media (prefers-color-scheme:dark){:root{--ink:#e8eaed;--soft:#a5adb7;--paper:#14171b;--rim:#3a424b;--grid:#2a3037;
--other:#4d565f;--link:#7db8f5;--c0:#4fadf0;--c1:#ff8d45;--c2:#2ecc9c;--c3:#ec9bc7;--c4:#e8b33a;--c5:#9bd4fa;--c6:#f0f0f0;
--yes:#4bd6a8;--no:#ff9d63;--open:#b9a8f5;--wall:#444c55;
--v1:#173249;--v2:#1d4d73;--v3:#2a6fa3;--v4:#4594cf;--v5:#83bfea;--v6:#d9effd}}
"""
"""CSS variables, so that every picture follows the reader's choice of light or dark. `c0` to `c6` can be told apart
with any kind of colour vision and stand out from their ground by 3:1 or more."""

PICTURES = """
svg text{font-size:11px;fill:var(--soft)}
text.x{text-anchor:middle}text.y,text.last{text-anchor:end}text.none{text-anchor:middle}
svg path{fill:none}
.grid{stroke:var(--grid);stroke-width:1}.axis,.tick{stroke:var(--soft);stroke-width:1}
.ceiling{stroke:var(--soft);stroke-width:1;stroke-dasharray:2 3}
.mean{stroke:var(--c);stroke-width:2;stroke-linejoin:round;stroke-linecap:round}.dash.mean{stroke-dasharray:5 4}
svg .band{fill:var(--c);fill-opacity:.16}.seed{stroke:var(--c);stroke-width:.7;stroke-opacity:.75}
.others{fill:none;stroke:var(--other);stroke-width:.7}
svg text.key{fill:var(--c);font-weight:700}
.c0{--c:var(--c0)}.c1{--c:var(--c1)}.c2{--c:var(--c2)}.c3{--c:var(--c3)}.c4{--c:var(--c4)}.c5{--c:var(--c5)}.c6{--c:var(--c6)}
.cursor{stroke:var(--ink);stroke-width:1;stroke-dasharray:3 2}svg .dot{fill:var(--c);stroke:var(--paper)}
svg .wall{fill:var(--wall)}.cell{stroke:var(--soft);stroke-width:.6}svg .here{stroke:var(--no);stroke-width:2}
[class^=v]{shape-rendering:crispEdges}svg .v1{fill:var(--v1)}svg .v2{fill:var(--v2)}svg .v3{fill:var(--v3)}
svg .v4{fill:var(--v4)}svg .v5{fill:var(--v5)}svg .v6{fill:var(--v6)}
"""
"""Of what is drawn, on the page and in files of their own."""

_PAGE = """
*{box-sizing:border-box}
body{margin:0 auto;padding:16px;max-width:1200px;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;overflow-wrap:anywhere}
h1{font-size:1.6rem;line-height:1.25;margin:.2em 0}h2{font-size:1.25rem;line-height:1.3;margin:0}
h3{font-size:1rem;margin:0}p{margin:.3em 0}a{color:var(--link)}
.soft,.measure{color:var(--soft);font-size:.875rem}
:focus-visible{outline:3px solid var(--link);outline-offset:2px}
nav ol{padding-left:1.6em;margin:.5em 0}nav li{margin:.35em 0}nav li>*{margin-right:.6em}
section{border-top:2px solid var(--rim);margin-top:32px;padding-top:20px}
.verdict{display:inline-block;border:1.5px solid;border-radius:4px;padding:0 .45em;font-size:.875rem;font-weight:600;
white-space:nowrap}
.holds{color:var(--yes)}.does-not-hold{color:var(--no)}.undecided{color:var(--open)}.not-run,.not-asked{color:var(--soft)}
.verdict.undecided{border-style:dashed}.verdict.not-run,.verdict.not-asked{border-style:dotted}
.reasons{list-style:none;padding:0;margin:.4em 0 0}.reasons li{margin:.15em 0}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.3em 1em;margin:.8em 0}
dt{color:var(--soft)}dd{margin:0;min-width:0}
@media (max-width:520px){dl{grid-template-columns:1fr;gap:0}dd{margin-bottom:.5em}}
.panels{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,440px),1fr));gap:24px}
figure{margin:0;min-width:0}.wide{grid-column:1/-1}
.plot{position:relative;container-type:inline-size}
.plot>svg{display:block;width:100%;height:auto;touch-action:pan-y;cursor:crosshair;border-radius:3px}
.defs{position:absolute;width:0;height:0}
.many{display:grid;grid-template-columns:repeat(auto-fill,minmax(150px,1fr));gap:12px;align-items:end}
.one p{font-size:.75rem;margin:0;display:flex;align-items:center;gap:4px}.one p svg{flex:none;margin:0}
.many .box{top:auto;bottom:100%}
"""
_AROUND = """
@container (min-width:410px){svg text{font-size:9.5px}}
@container (max-width:240px) and (min-width:181px){svg text{font-size:10px}}
.legend{display:flex;flex-wrap:wrap;gap:2px 16px;list-style:none;margin:.3em 0;padding:0;font-size:.875rem}
.legend b,.one b,.box b{color:var(--c)}.sample{width:22px;height:8px;margin-right:5px}
.swatch{width:12px;height:12px;margin-right:4px}
.box{position:absolute;top:4px;z-index:2;pointer-events:none;background:var(--paper);border:1px solid var(--soft);
border-radius:4px;padding:4px 8px;font-size:.8125rem;line-height:1.35;max-width:min(240px,90vw)}
.box table{width:auto;font-size:inherit;margin:0}.box td{border:0;padding:0 4px 0 0;text-align:left;vertical-align:top}
.box td:last-child{text-align:right;white-space:nowrap;padding:0 0 0 6px}
.said{position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap}
.tools{display:flex;flex-wrap:wrap;gap:6px 16px;align-items:center;font-size:.875rem}
.tools label,.tools a{padding:4px 0}button{font:inherit;color:var(--link);background:none;border:1px solid var(--rim);
border-radius:4px;padding:3px 10px;cursor:pointer}
.scroll{overflow-x:auto;margin:.6em 0}
table{border-collapse:collapse;font-size:.8125rem;font-variant-numeric:tabular-nums}
caption{text-align:left;color:var(--soft);padding-bottom:.3em}
caption span{display:block;position:sticky;left:0;max-width:calc(100vw - 32px)}
th,td{padding:3px 12px 3px 0;border-bottom:1px solid var(--rim);text-align:right;font-weight:400;white-space:nowrap}
th:first-child{text-align:left}thead th{font-weight:600;vertical-align:bottom;white-space:normal;overflow-wrap:normal}
pre{background:color-mix(in srgb,var(--grid) 60%,transparent);padding:10px;border-radius:4px;overflow-x:auto;
font-size:.8125rem;overflow-wrap:normal}
@media (prefers-reduced-motion:no-preference){html{scroll-behavior:smooth}}
@media print{.tools{display:none}}
"""
STYLE = f"{COLOURS}{_PAGE}{PICTURES}{_AROUND}"
"""The whole sheet; what is last wins."""

SCRIPT = r"""
(() => {
"use strict";
const NS = "http://www.w3.org/2000/svg";
const letter = i => String.fromCharCode(65 + i % 26) + (i >= 26 ? Math.floor(i / 26) : "");
const tone = i => "c" + i % 7 + (Math.floor(i / 7) % 2 ? " dash" : "");
const short = (v, digits = 3) => {
  const size = Math.abs(v);
  if (size >= 1e7 || (size > 0 && size < 1e-3)) return v.toExponential(digits - 1);
  return size >= 99.95 ? Math.round(v).toLocaleString("en") : String(Number(v.toPrecision(digits)));
};
const make = (parent, name, attributes) => {
  const made = document.createElementNS(NS, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  return parent.appendChild(made);
};
const put = (parent, name, text, kind) => {
  const made = parent.appendChild(document.createElement(name));
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
};
let reading = null;

// What all pictures share: where the pointer is, in the picture's own units, and a box that stays inside.
const point = (svg, event) => {
  const to = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  return [to.x, to.y];
};
const place = (svg, box, x) => {
  box.hidden = false;
  const whole = svg.viewBox.baseVal.width, room = svg.parentNode.clientWidth, at = x / whole * room;
  const left = at + 12 + box.offsetWidth <= room ? at + 12 : at - 12 - box.offsetWidth;
  box.style.left = Math.max(0, Math.min(left, Math.max(0, room - box.offsetWidth))) + "px";
};
const listen = (svg, hide, show, move) => {
  const read = event => { reading = svg; show(event); };
  for (const kind of ["pointermove", "pointerdown"]) svg.addEventListener(kind, read);
  const leave = () => { if (reading === svg) reading = null; hide(); };
  svg.addEventListener("pointerleave", event => {
    // A finger that was lifted leaves the box to be read; the next touch elsewhere takes it away.
    if (event.pointerType !== "touch") leave();
  });
  document.addEventListener("pointerdown", event => { if (!svg.contains(event.target)) leave(); });
  svg.addEventListener("keydown", event => {
    if (event.key === "Escape") leave();
    else if (move(event.key, event.shiftKey ? 10 : 1)) { reading = svg; event.preventDefault(); }
  });
  svg.addEventListener("blur", leave);
};
const save = (name, lines) => {
  const quoted = one => /[",\n\r]/.test(one) ? '"' + String(one).replaceAll('"', '""') + '"' : one;
  const text = lines.map(line => line.map(quoted).join(",")).join("\n") + "\n";
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], {type: "text/csv"}));
  link.download = name + ".csv";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
};

const curves = (figure, data) => {
  const [, , left, top, right, bottom] = data.box;
  const on = (scale, v) => scale[2] ? Math.log(v / scale[0]) / Math.log(scale[1] / scale[0])
    : (v - scale[0]) / (scale[1] - scale[0]);
  const px = step => left + on(data.x, step) * (right - left);
  const py = v => v === null || (data.y[2] && v <= 0) ? NaN : bottom - on(data.y, v) * (bottom - top);
  const read = (one, step) => {
    let t = -1;
    while (t + 1 < one.steps.length && one.steps[t + 1] <= step) t++;
    const gap = (one.steps.at(-1) - one.steps[0]) / Math.max(1, one.steps.length - 1);
    if (t < 0 || step > one.steps.at(-1) + gap) return null;
    const known = one.values.map(line => line[t]).filter(v => v !== null);
    if (!known.length) return null;
    const mean = known.reduce((a, b) => a + b, 0) / known.length;
    const squares = known.reduce((a, b) => a + (b - mean) ** 2, 0);
    return {mean, spread: known.length > 1 ? Math.sqrt(squares / (known.length - 1)) : null, count: known.length};
  };
  const written = (one, found) => !found ? "-" : short(found.mean)
    + (found.spread === null ? "" : " \u00b1 " + short(found.spread, 2))
    + (found.count === one.seeds.length ? "" : " (n = " + found.count + ")");
  const said = figure.querySelector(".said");
  for (const svg of figure.querySelectorAll(".plot > svg")) {
    const shown = svg.dataset.series === "" ? [] : svg.dataset.series.split(" ").map(Number);
    const steps = [...new Set(shown.flatMap(i => data.series[i].steps))].sort((a, b) => a - b);
    if (!steps.length) continue;
    const live = svg.querySelector(".live"), box = svg.parentNode.querySelector(".box");
    let at = -1;
    const hide = () => { at = -1; live.replaceChildren(); box.hidden = true; };
    const show = (next, aloud) => {
      at = Math.max(0, Math.min(steps.length - 1, next));
      const step = steps[at], x = px(step);
      live.replaceChildren();
      box.replaceChildren();
      make(live, "path", {class: "cursor", d: `M${x} ${top}V${bottom}`});
      put(box, "div", "at " + step.toLocaleString("en"));
      const table = put(box, "table", "");
      const found = shown.map(i => [i, data.series[i], read(data.series[i], step)]);
      found.sort((a, b) => (b[2] ? b[2].mean : -Infinity) - (a[2] ? a[2].mean : -Infinity));
      for (const [i, one, value] of found) {
        const line = put(table, "tr", "", tone(i));
        put(put(line, "td", ""), "b", letter(i));
        put(line, "td", one.label);
        put(line, "td", written(one, value));
        if (value && Number.isFinite(py(value.mean)))
          make(live, "circle", {class: "dot " + tone(i), cx: x, cy: py(value.mean), r: 3.2});
      }
      place(svg, box, x);
      const all = found.map(([, one, value]) => one.label + " " + written(one, value));
      if (aloud) said.textContent = "at " + step + ": " + all.join(", ");
    };
    const nearest = event => {
      const x = point(svg, event)[0];
      let best = 0;
      steps.forEach((step, t) => { if (Math.abs(px(step) - x) < Math.abs(px(steps[best]) - x)) best = t; });
      show(best);
    };
    const move = (key, far) => {
      const last = steps.length - 1;
      const to = {ArrowRight: at + far, ArrowLeft: at < 0 ? last : at - far, Home: 0, End: last}[key];
      if (to === undefined) return false;
      show(to, true);
      return true;
    };
    listen(svg, hide, nearest, move);
  }
  const each = figure.querySelector(".each");
  const seeds = () => {
    for (const svg of figure.querySelectorAll(".plot > svg")) {
      const group = svg.querySelector(".seeds");
      group.replaceChildren();
      if (!each.checked || svg.dataset.series === "") continue;
      for (const i of svg.dataset.series.split(" ").map(Number)) {
        const one = data.series[i];
        for (const line of one.values) {
          let d = "", pen = false;
          line.forEach((v, t) => {
            const y = py(v);
            if (!Number.isFinite(y)) { pen = false; return; }
            d += (pen ? "L" : "M") + px(one.steps[t]).toFixed(1) + " " + y.toFixed(1);
            pen = true;
          });
          make(group, "path", {class: "seed " + tone(i), d});
        }
      }
    }
  };
  each.addEventListener("change", seeds);
  if (each.checked) seeds();
  figure.querySelector(".save").addEventListener("click", () => save(data.csv, [
    ["series", "seed", data.column, "value"],
    ...data.series.flatMap(one => one.values.flatMap((line, s) =>
      line.map((v, t) => [one.label, one.seeds[s], one.steps[t], v === null ? "" : v])))]));
};

const visits = (figure, data) => {
  const svg = figure.querySelector(".plot > svg"), box = figure.querySelector(".box");
  const live = svg.querySelector(".live"), said = figure.querySelector(".said");
  const unit = 320 / data.columns, [x0, y0, side] = data.floor;
  const squares = new Map(data.squares.map(([r, c, n, s]) => [r * data.columns + c, [n, s]]));
  const middle = (low, number) => low + (number + .5) * side;
  let at = null;
  const hide = () => { at = null; live.replaceChildren(); box.hidden = true; };
  const show = (row, column, aloud) => {
    row = Math.max(0, Math.min(data.rows - 1, row));
    column = Math.max(0, Math.min(data.columns - 1, column));
    at = [row, column];
    const x = 32 + column * unit, y = 6 + (data.rows - 1 - row) * unit;
    live.replaceChildren();
    make(live, "path", {class: "here", d: `M${x} ${y}h${unit}v${unit}h${-unit}z`});
    const [n, s] = squares.get(row * data.columns + column) || [0, 0];
    const lines = ["x " + middle(x0, column).toFixed(2) + " m, y " + middle(y0, row).toFixed(2) + " m",
      n.toLocaleString("en") + " visits, " + (100 * n / Math.max(1, data.total)).toFixed(2) + " %", s + " seeds"];
    box.replaceChildren();
    for (const line of lines) put(box, "div", line);
    place(svg, box, x + unit);
    if (aloud) said.textContent = lines.join(", ");
  };
  const nearest = event => {
    const [x, y] = point(svg, event);
    show(data.rows - 1 - Math.floor((y - 6) / unit), Math.floor((x - 32) / unit));
  };
  const move = (key, far) => {
    const by = {ArrowRight: [0, far], ArrowLeft: [0, -far], ArrowUp: [far, 0], ArrowDown: [-far, 0]}[key];
    if (!by) return false;
    at ? show(at[0] + by[0], at[1] + by[1], true) : show(data.rows >> 1, data.columns >> 1, true);
    return true;
  };
  listen(svg, hide, nearest, move);
  figure.querySelector(".save").addEventListener("click", () => save(data.csv, [["x", "y", "visits", "seeds"],
    ...data.squares.map(([r, c, n, s]) => [middle(x0, c).toFixed(4), middle(y0, r).toFixed(4), n, s])]));
};

const figures = [...document.querySelectorAll("figure")];
const key = "report " + location.pathname;
let kept = {};
try { kept = JSON.parse(sessionStorage.getItem(key)) || {}; } catch { /* Some browsers keep nothing. */ }
figures.forEach((figure, i) => {
  const each = figure.querySelector(".each");
  if (each && kept.each && kept.each[i]) each.checked = true;
  const data = JSON.parse(figure.querySelector('script[type="application/json"]').textContent);
  (data.floor ? visits : curves)(figure, data);
});
const seconds = Number(document.documentElement.dataset.refresh);
if (seconds > 0) {
  if (kept.at !== undefined && !location.hash) scrollTo({top: kept.at, behavior: "instant"});
  else if (kept.at !== undefined) setTimeout(() => scrollTo({top: kept.at, behavior: "instant"}), 0);
  const again = () => {
    // Not under the eyes of someone who reads a value.
    if (reading) { setTimeout(again, 1000); return; }
    const each = figures.map(figure => Boolean(figure.querySelector(".each")?.checked));
    try { sessionStorage.setItem(key, JSON.stringify({at: scrollY, each})); } catch { /* As above. */ }
    location.reload();
  };
  setTimeout(again, 1000 * seconds);
} else try { sessionStorage.removeItem(key); } catch { /* As above. */ }
})();
"""
"""Values at a vertical cursor by pointer, touch and arrow keys, a line for each seed, CSV from the page, and loading
again. Text from the report is only ever set as text."""
