"use strict";
// The list of frames, the histogram and the view of a frame. All that is shown comes from the JSON in
// #data, and goes onto the page as text, never as markup.

const { head: data, frames } = JSON.parse(document.getElementById("data").textContent);
const columns = data.columns.map((measure) => ({
  ...measure, unit: measure.shown_unit || measure.unit, factor: measure.shown_factor,
  higher_is_better: measure.better === "higher", signed: data.signed.includes(measure.key),
}));
const LABELS = { first: "Before", second: "After", map: "Change of error", image: "Image",
  sparse: "Sparse depth", gt: "Ground truth" };
const NAME = -1; // the "column" of the names
const PAGE = 1000; // rows that are made at once
const BINS = 24;

const byId = (id) => document.getElementById(id);

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "text") element.textContent = value;
    else if (key in element && typeof value !== "string") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

// Control characters, such as a new line in a name, would be invisible.
const visible = (text) =>
  text.replace(/[\u0000-\u001f\u007f-\u009f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]/gu,
    (c) => "\\u" + c.codePointAt(0).toString(16).padStart(4, "0"));

const formats = new Map(columns.map((column) => [column, new Intl.NumberFormat("en", {
  minimumFractionDigits: column.decimals, maximumFractionDigits: column.decimals,
  signDisplay: column.signed ? "exceptZero" : "auto",
})]));

function shown(column, value) {
  if (value === null || value === undefined) return "–";
  const { factor, percent } = column;
  const number = formats.get(column).format(value * (percent ? 100 : factor));
  return (percent ? number + "%" : number).replace("-", "−");
}

const titled = (column) => column.title + (column.unit ? ` [${column.unit}]` : "");

const noted = (note) =>
  make("li", { class: note.startsWith("warning") ? "warning" : "", text: visible(note) });

// A view of a frame: a panel (left, top, width, height) of a figure.
function picture(frame, view, attributes, ratio) {
  const { src, box, size } = frame.views[view];
  const image = make("img", { ...attributes, src }); // src last: nothing is read before it is in view
  let [x, y, w, h] = box;
  if (ratio && w > h * ratio) [x, w] = [x + (w - h * ratio) / 2, h * ratio];
  else if (ratio) [y, h] = [y + (h - w / ratio) / 2, w / ratio];
  Object.assign(image.style, { width: `${100 * size[0] / w}%`, left: `${-100 * x / w}%`,
    top: `${-100 * y / h}%` });
  const panel = make("span", { class: "panel" }, image);
  panel.style.aspectRatio = `${w} / ${h}`;
  return panel;
}

// ---- the histogram ----

function svg(tag, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

function roundStep(rough) {
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 2.5, 5, 10].map((m) => m * power).find((step) => step >= rough * 0.999999);
}

// Bins of a round width, with an edge at 0; what lies far out is counted in the bin at the end.
function binned(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const at = (fraction) => sorted[Math.round(fraction * (sorted.length - 1))];
  let [low, high] = [at(0), at(1)];
  const room = 3 * (at(0.9) - at(0.1));
  if (room > 0) [low, high] = [Math.max(low, at(0.1) - room), Math.min(high, at(0.9) + room)];
  const span = high - low || Math.abs(high) * 0.2 || 1;
  const step = roundStep(span / BINS);
  const first = Math.floor(low / step + 1e-9);
  const count = Math.max(1, Math.ceil(high / step - 1e-9) - first);
  const bins = Array.from({ length: count }, (_, i) => ({
    low: (first + i) * step, high: (first + i + 1) * step, frames: 0 }));
  for (const value of values) {
    const position = Math.floor(value / step + 1e-9) - first;
    bins[Math.min(Math.max(position, 0), count - 1)].frames += 1;
  }
  return { bins, median: (at(0.5) + sorted[Math.floor((sorted.length - 1) / 2)]) / 2 };
}

function drawChart() {
  const index = Number(byId("chart-column").value);
  const column = columns[index];
  const values = frames.map((f) => f.values[index]).filter((v) => v !== null);
  const figure = byId("chart");
  if (!values.length) return figure.replaceChildren(make("p", { text: "No frame has it." }));
  const { bins, median } = binned(values);
  const W = Math.min(Math.max(figure.clientWidth, 280), 600); // so that letters keep their size
  const [H, left, right, top, bottom] = [240, 40, 14, 12, 40];
  const most = Math.max(...bins.map((bin) => bin.frames));
  const step = Math.max(1, roundStep(most / 4));
  const x = (i) => left + (i * (W - left - right)) / bins.length;
  const y = (n) => H - bottom - (n * (H - top - bottom)) / most;
  const chart = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img" });
  for (let n = 0; n <= most; n += step) {
    if (n % 1) continue;
    chart.append(svg("line", { x1: left, x2: W - right, y1: y(n), y2: y(n), class: "grid" }),
      svg("text", { x: left - 8, y: y(n) + 4, class: "left" }, String(n)));
  }
  bins.forEach((bin, i) => {
    const kind = !column.signed ? "" : bin.low < -1e-12 ? "better" : "worse";
    const bar = svg("rect", { x: x(i) + 1, width: Math.max(1, x(1) - x(0) - 2), y: y(bin.frames),
      height: y(0) - y(bin.frames), class: `bar ${kind}` });
    const range = `${shown(column, bin.low)} to ${shown(column, bin.high)}`;
    bar.append(svg("title", {}, `${range}: ${bin.frames} frame${bin.frames === 1 ? "" : "s"}`));
    chart.append(bar);
  });
  const [low, high] = [bins[0].low, bins[bins.length - 1].high];
  const apart = roundStep((high - low) / (W / 80));
  for (let n = Math.ceil(low / apart - 1e-9); n * apart <= high + 1e-9 * apart; n += 1) {
    const position = ((n * apart - low) / (high - low)) * bins.length;
    chart.append(svg("text", { x: x(position), y: H - bottom + 17 }, tick(column, n * apart)));
  }
  const label = titled(column) + (column.percent ? " [%]" : "");
  chart.append(svg("text", { x: (left + W - right) / 2, y: H - 3 }, label));
  const better = values.filter((v) => v < 0).length;
  const worse = values.filter((v) => v > 0).length;
  const count = values.length.toLocaleString("en");
  const summary = `${count} frames, median ${shown(column, median)} ${column.unit}`.trim() +
    (column.signed ? `; ${better} better, ${worse} worse` : "");
  chart.setAttribute("aria-label", `Histogram of ${titled(column)}: ${summary}`);
  figure.replaceChildren(chart, make("figcaption", { text: summary }));
}

function tick(column, value) {
  const number = value * (column.percent ? 100 : column.factor);
  return Number(number.toPrecision(4)).toLocaleString("en").replace("-", "−");
}

// ---- the list ----

const list = { column: data.sort_by, worst: true, order: [], limit: PAGE, at: 0 };
const made = new Map(); // a row is made when it is first shown

function compared(a, b) {
  if (list.column === NAME) {
    const names = frames[a].name < frames[b].name ? -1 : frames[a].name > frames[b].name ? 1 : 0;
    return list.worst ? names : -names;
  }
  const [p, q] = [frames[a].values[list.column], frames[b].values[list.column]];
  if (p === null || q === null) return (p === null) - (q === null) || a - b;
  const low_first = columns[list.column].higher_is_better === list.worst;
  return (low_first ? p - q : q - p) || a - b;
}

function sortList() {
  const wanted = byId("filter").value.toLowerCase();
  const hit = (frame) => visible(frame.name).toLowerCase().includes(wanted);
  list.order = frames.map((_, i) => i).filter((i) => hit(frames[i])).sort(compared);
  list.at = 0;
  showRows();
}

function showRows() {
  const part = list.order.slice(0, list.limit);
  byId("rows").replaceChildren(...part.map(rowOf));
  list.at = Math.min(list.at, Math.max(0, part.length - 1));
  part.forEach((i, n) => { opener(i).tabIndex = n === list.at ? 0 : -1; });
  const left = list.order.length - part.length;
  byId("more").hidden = !left;
  byId("more").textContent = `Show ${Math.min(left, PAGE).toLocaleString("en")} more`;
  const [some, all] = [list.order.length, frames.length].map((n) => n.toLocaleString("en"));
  byId("count").textContent = some === all
    ? `${all} frame${all === "1" ? "" : "s"}.` : `${some} of ${all} frames.`;
  sayOrder();
}

function sayOrder() {
  const byName = list.column === NAME;
  byId("sort-column").value = String(list.column);
  const [first, second] = byName ? ["A to Z", "Z to A"] : ["Worst first", "Best first"];
  byId("sort-turn").textContent = list.worst ? first : second;
  byId("sort-turn").setAttribute("aria-label",
    `Order: ${list.worst ? first : second}; turn to ${list.worst ? second : first}`);
  const higher = !byName && columns[list.column].higher_is_better;
  const ascending = byName ? list.worst : higher === list.worst;
  for (const cell of byId("head").children) {
    const sorted = Number(cell.dataset.column) === list.column;
    if (sorted) cell.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    else cell.removeAttribute("aria-sort");
  }
}

function rowOf(index) {
  if (!made.has(index)) made.set(index, makeRow(index));
  return made.get(index);
}

const opener = (index) => rowOf(index).querySelector("button");

function makeRow(index) {
  const frame = frames[index];
  const name = visible(frame.name);
  const thumbs = make("span", { class: "thumbs" });
  const views = ["image", "map", "second"].filter((view) => frame.key && view in frame.views);
  for (const view of views.slice(0, 2)) {
    thumbs.append(picture(frame, view, { loading: "lazy", decoding: "async", alt: "" }, 4 / 3));
  }
  const button = make("button", { type: "button", class: "open", text: name,
    "aria-label": `Open frame ${name}`, "aria-haspopup": "dialog" });
  const cell = make("th", { scope: "row" }, make("div", {}, thumbs, button));
  if (frame.tag) button.after(make("span", { class: "tag", text: frame.tag }));
  const row = make("tr", { "data-index": String(index) }, cell);
  columns.forEach((column, i) => {
    if (!column.main) return;
    const value = frame.values[i];
    const text = shown(column, value);
    const kind = !column.signed || !/[1-9]/.test(text) ? "" : value < 0 ? "better" : "worse";
    row.append(make("td", { "data-label": titled(column), class: kind, text }));
  });
  return row;
}

function fillHeader() {
  const cellOf = (text, index) => {
    const button = make("button", { type: "button", text });
    button.addEventListener("click", () => {
      list.worst = list.column === index ? !list.worst : true;
      list.column = index;
      sortList();
    });
    return make("th", { scope: "col", "data-column": String(index) }, button);
  };
  byId("head").append(cellOf("Frame", NAME));
  columns.forEach((column, i) => { if (column.main) byId("head").append(cellOf(titled(column), i)); });
  const choices = () => columns.map((c, i) => make("option", { value: String(i), text: titled(c) }));
  byId("sort-column").append(...choices(), make("option", { value: String(NAME), text: "Name" }));
  byId("chart-column").append(...choices());
  byId("chart-column").value = String(data.sort_by);
}

function moveTo(position) {
  const shownRows = Math.min(list.limit, list.order.length);
  if (!shownRows) return;
  opener(list.order[list.at]).tabIndex = -1;
  list.at = Math.min(Math.max(position, 0), shownRows - 1);
  const button = opener(list.order[list.at]);
  button.tabIndex = 0;
  button.focus({ preventScroll: true });
  button.closest("tr").scrollIntoView({ block: "nearest" });
}

function listenToList() {
  byId("sort-column").addEventListener("change", (event) => {
    list.column = Number(event.target.value);
    list.worst = true;
    sortList();
  });
  byId("sort-turn").addEventListener("click", () => { list.worst = !list.worst; sortList(); });
  byId("filter").addEventListener("input", () => { list.limit = PAGE; sortList(); });
  byId("more").addEventListener("click", () => {
    const next = list.limit;
    list.limit += PAGE;
    showRows();
    moveTo(next);
  });
  byId("rows").addEventListener("click", (event) => {
    const row = event.target.closest("tr");
    if (row && !String(getSelection())) openFrame(list.order.indexOf(Number(row.dataset.index)));
  });
  byId("rows").addEventListener("keydown", (event) => {
    const steps = { ArrowDown: list.at + 1, ArrowUp: list.at - 1, Home: 0, End: Infinity,
      PageDown: list.at + 8, PageUp: list.at - 8 };
    if (!(event.key in steps) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    moveTo(steps[event.key]);
  });
}

// ---- one frame ----

function openFrame(position) {
  const frame = frames[list.order[position]];
  moveTo(position);
  byId("frame-title").textContent = visible(frame.name);
  byId("views").replaceChildren(...viewsOf(frame));
  byId("values").replaceChildren(...columns.map((column, i) => make("div", {},
    make("dt", { text: titled(column) }), make("dd", { text: shown(column, frame.values[i]) }))));
  byId("frame-notes").replaceChildren(...frame.notes.map(noted));
  const shownRows = Math.min(list.limit, list.order.length);
  byId("previous").disabled = position === 0;
  byId("next").disabled = position === shownRows - 1;
  const dialog = byId("frame");
  if (!dialog.open) dialog.showModal();
  dialog.scrollTop = 0;
  (dialog.querySelector("input[type=range]") || byId("close")).focus({ preventScroll: true });
}

function viewsOf(frame) {
  if (!frame.key) return [make("p", { text: "There are no images of this frame." })];
  const views = [slider(frame), ...(frame.map ? [mapView(frame)] : [])];
  for (const view of ["image", "sparse"]) {
    if (view in frame.views) views.push(plainView(frame, view));
  }
  if (frame.view_mb) views.push(spaceView(frame));
  return views;
}

function bigPicture(frame, view) {
  return picture(frame, view, { draggable: "false",
    alt: `${LABELS[view]} of ${visible(frame.name)}` });
}

function legend(colours, low, high, remark) {
  const bar = make("span", { class: "colours" });
  bar.style.background = `linear-gradient(to right, ${colours.join(",")})`;
  const line = make("span", { class: "legend" }, make("span", { text: low }), bar,
    make("span", { text: high }));
  return remark ? [line, make("span", { class: "remark", text: remark })] : [line];
}

function slider(frame) {
  const { first, second } = LABELS;
  const over = make("div", { class: "over" }, bigPicture(frame, "first"));
  const handle = make("div", { class: "handle", "aria-hidden": "true" });
  const range = make("input", { type: "range", min: "0", max: "100", value: "50", step: "1",
    "aria-label": `${first} to the left, ${second} to the right: position of the border` });
  const stage = make("div", { class: "stage" }, bigPicture(frame, "second"), over, handle,
    make("span", { class: "label left", text: first, "aria-hidden": "true" }),
    make("span", { class: "label right", text: second, "aria-hidden": "true" }), range);
  const move = () => {
    over.style.clipPath = `inset(0 ${100 - range.value}% 0 0)`;
    handle.style.left = `${range.value}%`;
    range.setAttribute("aria-valuetext", `${range.value} % ${first}, ${100 - range.value} % ${second}`);
  };
  range.addEventListener("input", move);
  move();
  const metres = (value) => `${Number(value.toPrecision(3))} ${data.unit}`;
  const [low, high] = frame.scale_m;
  const caption = make("figcaption", {}, ...legend(data.depth_colours, metres(low), metres(high),
    high / low > data.logarithmic_from ? "Logarithmic colours, the same on both sides." : ""));
  return make("figure", { class: "slider" }, stage, caption);
}

function mapView(frame) {
  const { ends, unknown, footer } = frame.map;
  const remark = footer + (unknown ? `; dark: ${unknown}` : "");
  return make("figure", {}, make("div", { class: "stage" }, bigPicture(frame, "map"),
    make("span", { class: "label left", text: LABELS.map, "aria-hidden": "true" })),
  make("figcaption", {}, ...legend(data.map_colours, ends[0], ends[1], remark)));
}

function plainView(frame, view) {
  return make("figure", {}, make("div", { class: "stage" }, bigPicture(frame, view),
    make("span", { class: "label left", text: LABELS[view], "aria-hidden": "true" })));
}

// ---- the 3D view, whose scripts are loaded when it is first opened ----

const space = { open: false, frame: null };

function spaceView(frame) {
  const stage = make("div", { class: "stage space" });
  const figure = make("figure", { class: "wide" }, stage);
  const open = make("button", { type: "button", class: "load",
    text: `Open the 3D view (${frame.view_mb} MB)` });
  open.addEventListener("click", () => { space.open = true; loadSpace(frame, figure, stage); });
  stage.append(open);
  if (space.open) loadSpace(frame, figure, stage);
  return figure;
}

function loadScript(source) {
  return new Promise((resolve, reject) => {
    const script = make("script", { src: source });
    script.addEventListener("load", () => { script.remove(); resolve(); });
    script.addEventListener("error", () => { script.remove(); reject(new Error(source)); });
    document.head.append(script);
  });
}

async function loadSpace(frame, figure, stage) {
  space.frame = frame;
  stage.replaceChildren(make("p", { class: "load", role: "status", text: "Loading …" }));
  let content;
  window.pnpdepthView = (given) => { content = given; };
  try {
    if (!space.loaded) await loadScript("viewer.js");
    space.loaded = true;
    await loadScript(`images/${frame.key}_view.js`);
    if (space.frame !== frame) return; // another frame was opened meanwhile
    fillSpace(frame, figure, stage, content);
  } catch (error) {
    const why = `The 3D view cannot be shown: ${error.message}`;
    stage.replaceChildren(make("p", { class: "load", text: why }));
  }
}

function fillSpace(frame, figure, stage, content) {
  const canvas = pnpdepthViewer.show(content);
  const names = { before: LABELS.first, after: LABELS.second, gt: LABELS.gt };
  const count = make("span", { class: "count", role: "status" });
  const choose = (name) => {
    const label = `${names[name]} in 3D, ${visible(frame.name)}`;
    const points = pnpdepthViewer.choose(name, label);
    count.textContent = `${points.toLocaleString("en")} points`;
    space.shown = name;
  };
  const shown = space.shown in content.depths ? space.shown : "after";
  const choices = Object.keys(content.depths).map((name) => {
    const input = make("input", { type: "radio", name: "cloud", value: name,
      checked: name === shown });
    input.addEventListener("change", () => choose(name));
    return make("label", {}, input, make("span", { text: names[name] }));
  });
  const reset = make("button", { type: "button", text: "Reset view" });
  reset.addEventListener("click", () => pnpdepthViewer.reset());
  stage.replaceChildren(canvas);
  figure.replaceChildren(stage,
    make("div", { class: "switch", role: "radiogroup", "aria-label": "Cloud" }, ...choices, reset,
      count),
    make("figcaption", { text: "Drag to rotate, wheel or pinch to zoom, drag with the right button" +
      " or two fingers to move." }));
  choose(shown);
}

function closeSpace() {
  if (space.loaded) pnpdepthViewer.clear();
  space.frame = null;
}

function listenToFrame() {
  const dialog = byId("frame");
  const step = (by) => {
    const position = list.at + by;
    if (position >= 0 && position < Math.min(list.limit, list.order.length)) openFrame(position);
  };
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  byId("close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener("close", () => { closeSpace(); moveTo(list.at); });
  dialog.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const by = { n: 1, p: -1 }[event.key.toLowerCase()];
    if (by) step(by);
  });
}

fillHeader();
listenToList();
listenToFrame();
sortList();
byId("spread").hidden = frames.length < 2;
drawChart();
byId("chart-column").addEventListener("change", drawChart);
addEventListener("resize", drawChart);
