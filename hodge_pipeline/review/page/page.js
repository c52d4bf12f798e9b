// The page of a review. All state is the server's: this shows it, and asks for changes with the revision that it shows.
"use strict";
const $ = (id) => document.getElementById(id);
const VERDICTS = ["wrong", "suspect", "untestable", "consistent"];
const SORTS = [...$("table").tHead.querySelectorAll("[data-sort]")].map((head) => head.dataset.sort);
const COUNT = 100;
let state = { revision: -1, version: -1, look: { selected: -1, verdicts: [] } };
let rows = [], total = 0, first = 0, sort = "score", descending = false, shown = new Set(["wrong", "suspect"]);
let described = "", listed = "", offered = "";

async function ask(name, body) {
  const options = body === undefined ? {} : { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(name, options);
  const found = await answer.json();
  if (!answer.ok) throw new Error(found.error);
  return found;
}

async function act(name, body = {}) {
  try {
    const found = await ask(name, { revision: state.revision, note: $("note").value, ...body });
    if (["decide", "wrong", "accept", "undo", "redo"].includes(name)) $("note").value = "";
    tell("");
    show(found.state);
  } catch (error) {
    tell(error.message);
  }
}

function tell(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

function metres(value) {
  if (value === null || value === undefined) return "–";
  if (state.unit !== "m") return value.toPrecision(3);
  return value < 0.1 ? `${(100 * value).toFixed(value < 0.01 ? 2 : 1)} cm` : `${value.toFixed(2)} m`;
}

function element(tag, text, className) {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function show(found) {
  if (found.version < state.version) return;
  shown = new Set(found.look.verdicts);
  state = found;
  document.title = `${state.name} – hodge review`;
  $("name").textContent = `${state.name}: ${state.poses} ${state.poses === 1 ? "pose" : "poses"}, ${state.counting} of ${state.edges} edges count`;
  const error = state.error_m === null ? "" : `; error ${metres(state.first_error_m)} at first, ${metres(state.error_m)} now`;
  $("facts").textContent = `${state.disabled} disabled, ${state.pieces} ${state.pieces === 1 ? "piece" : "pieces"}${error}` + (state.to_register.length ? `; hodge solve will register ${state.to_register.join(", ")}` : "");
  const behind = state.settled_revision !== state.revision;
  $("latency").textContent = state.doing ? `${state.doing} …` : behind ? "" : state.settled_revision ? `solved in ${(1000 * state.seconds).toFixed(0)} ms, moved by up to ${metres(state.moved_m)}${state.converged ? "" : "; not converged"}` : state.notes.join("; ");
  document.body.dataset.doing = state.doing;
  document.body.dataset.revision = state.revision;
  document.body.dataset.settled = state.settled_revision;
  document.body.dataset.version = state.version;
  $("locked").textContent = state.locked;
  $("locked").hidden = !state.locked;
  if (state.message) tell(state.message);
  for (const name of ["disable", "enable", "right"]) $(name).disabled = Boolean(state.locked) || state.look.selected < 0;
  $("undo").disabled = !state.can_undo; $("undo").title = state.latest;
  $("redo").disabled = !state.can_redo;
  $("wrong").disabled = Boolean(state.locked) || !state.verdicts.wrong;
  $("finishes").textContent = state.finish; $("unit").textContent = state.unit; $("adding").hidden = !state.is_run;
  $("view").hidden = !state.has_clouds;
  for (const button of $("view").querySelectorAll("button")) button.classList.toggle("on", button.dataset.mode === state.look.mode);
  showFilters();
  showCandidate();
  list();
  describe();
  suggest();
  log();
}

function showFilters() {
  $("verdicts").replaceChildren(...VERDICTS.map((verdict) => {
    const button = element("button", `${verdict} ${state.verdicts[verdict] || 0}`, shown.has(verdict) ? "on " + verdict : verdict);
    button.onclick = () => {
      if (shown.has(verdict)) shown.delete(verdict); else shown.add(verdict);
      first = 0;
      act("look", { verdicts: [...shown] });
    };
    return button;
  }));
}

async function list(always) {
  const query = new URLSearchParams({ verdicts: [...shown].join(","), frame: $("frame").value, min_gap: $("gap").value, min_residual_m: $("residual").value, sort, descending, first, count: COUNT });
  const version = state.version, key = `${query} ${version}`;
  if (key === listed && !always) return;
  listed = key;
  try {
    const found = await ask(`edges?${query}`);
    if (key !== listed) return;
    rows = found.edges; total = found.total;
    fill($("table").tBodies[0]);
    $("place").textContent = total ? `${first + 1}–${first + rows.length} of ${total}` : state.edges ? "no such edge: choose other verdicts, or empty the fields above" : "no edges";
    $("before").disabled = first === 0; $("after").disabled = first + rows.length >= total;
    for (const head of $("table").tHead.rows[0].cells) head.classList.toggle("sorted", head.dataset.sort === sort);
    document.body.dataset.listed = version;
  } catch (error) {
    tell(error.message);
  }
}

// Rows are filled anew where they stand: one that is replaced between press and release of the mouse gets no click.
function fill(body) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  while (body.rows.length < rows.length) {
    const row = body.insertRow(-1);
    for (let k = 0; k < 7; k++) row.insertCell(-1);
    row.onclick = () => act("select", { row: Number(row.dataset.row) });
  }
  rows.forEach((edge, at) => fillRow(body.rows[at], edge));
}

function fillRow(row, edge) {
  row.dataset.row = edge.row; row.dataset.name = edge.name;
  row.className = [edge.row === state.look.selected ? "selected" : "", edge.counts ? "" : "off"].join(" ");
  const score = edge.score === null ? "" : ` ${edge.score.toFixed(2)}`;
  const said = edge.decision ? ` (${edge.decision})` : ["used", "disabled"].includes(edge.status) ? "" : ` (${edge.status})`;
  const texts = [edge.name, `${edge.verdict}${score}${said}`, metres(edge.residual_m), edge.residual_deg === null ? "–" : edge.residual_deg.toFixed(1), edge.gap, edge.cycles === null ? "–" : `${edge.closing} of ${edge.cycles}`, edge.reason];
  texts.forEach((text, at) => { row.cells[at].textContent = text; });
  row.cells[1].className = edge.verdict;
}

async function describe() {
  const row = state.look.selected, key = `${row} ${state.settled_revision} ${state.doing === ""}`;
  if (key === described) return;
  described = key;
  $("edge").hidden = row < 0;
  if (row < 0) return;
  try {
    const found = await ask(`edge?row=${row}`);
    if (key !== described) return;
    $("edge-name").textContent = found.name + (found.beside > 1 ? ` (${found.beside} edges join these two: a decision is about all)` : "");
    $("cycles").replaceChildren(...found.cycles.map((cycle) => element("li", `${cycle.text} ${cycle.error}`, cycle.closes ? "closes" : "fails")));
    $("pictures").replaceChildren(...found.pictures.map((picture, number) => {
      const figure = document.createElement("figure"), image = new Image();
      image.src = `picture?row=${row}&number=${number}&revision=${state.settled_revision}`;
      image.alt = picture.title;
      figure.append(element("figcaption", `${picture.title}. ${picture.caption}`), image);
      return figure;
    }));
  } catch (error) {
    tell(error.message);
  }
}

function showCandidate() {
  const found = state.candidate;
  $("candidate").hidden = !found;
  if (!found) {
    const picked = state.look.picked;
    if (picked.length) { $("first").value = picked[0]; $("second").value = picked[1] || ""; }
    return;
  }
  [$("first").value, $("second").value] = state.look.picked;
  const result = found.registered ? `fitness ${found.fitness}, RMS ${metres(found.rmse_m)}, ${metres(found.residual_m)} and ${found.residual_deg}° from the poses; ${found.rejected ? `acceptance rejects it: ${found.rejected}; adding lets it in all the same` : "acceptance takes it"}` : `guess from ${found.guess_by}${found.points && found.points < 3 ? `, ${found.points} point pairs clicked` : ""}: register it`;
  $("found").textContent = `${found.pair}: ${result}`;
  $("accept").disabled = !found.registered;
}

async function suggest() {
  const key = `${$("adding").open} ${state.settled_revision} ${state.doing === ""}`;
  if (!$("adding").open || key === offered) return;
  offered = key;
  const found = await ask("suggestions");
  $("suggestions").replaceChildren(...found.map((one) => {
    const item = element("li", ""), button = element("button", one.pair);
    button.onclick = () => act("pick", { rows: one.frames });
    item.append(button, ` ${one.reason}`);
    return item;
  }));
}

async function log() {
  if (!$("decided").open) return;
  const found = await ask("log");
  $("log").replaceChildren(...found.map((line) => element("li", `${line.time} ${line.who}: ${line.decision} ${line.pairs} ${line.note ? `– ${line.note}` : ""}`)));
}

function decide(verb) {
  if (state.look.selected >= 0) act("decide", { verb, rows: [state.look.selected] });
}

function step(by) {
  const at = rows.findIndex((edge) => edge.row === state.look.selected);
  const next = rows[at < 0 ? (by > 0 ? 0 : rows.length - 1) : Math.min(Math.max(at + by, 0), rows.length - 1)];
  if (next) act("select", { row: next.row });
}

function sortBy(key) {
  descending = sort === key ? !descending : false;
  sort = key; first = 0;
  list();
}

const KEYS = {
  j: () => step(1), k: () => step(-1), d: () => decide("disable"), e: () => decide("enable"), r: () => decide("right"),
  u: () => act("undo"), y: () => act("redo"), w: () => act("wrong"), s: () => act("finish"), n: () => $("note").focus(),
  o: () => { descending = false; sortBy(SORTS[(SORTS.indexOf(sort) + 1) % SORTS.length]); },
  1: () => act("look", { mode: "all" }), 2: () => act("look", { mode: "edge" }), 3: () => act("look", { mode: "solution" }), 4: () => act("look", { mode: "blink" }),
};

function pressed(event) {
  if (event.key === "Escape" && document.activeElement) document.activeElement.blur();
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|TEXTAREA)$/.test(event.target.tagName)) return;
  const key = KEYS[event.key];
  if (key) { event.preventDefault(); event.stopPropagation(); key(); }
}

function hasWebGl() {
  return Boolean(document.createElement("canvas").getContext("webgl2")); // viser cannot draw with the first WebGL
}

for (const verb of ["disable", "enable", "right"]) $(verb).onclick = () => decide(verb);
for (const name of ["undo", "redo", "wrong", "finish", "register", "accept"]) $(name).onclick = () => act(name);
for (const head of $("table").tHead.rows[0].cells) if (head.dataset.sort) head.onclick = () => sortBy(head.dataset.sort);
for (const name of ["frame", "gap", "residual"]) $(name).onchange = () => { first = 0; list(); };
for (const button of $("view").querySelectorAll("button")) button.onclick = () => act("look", { mode: button.dataset.mode });
$("before").onclick = () => { first = Math.max(0, first - COUNT); list(); };
$("after").onclick = () => { first += COUNT; list(); };
$("share").oninput = () => act("look", { mode: "between", share: Number($("share").value) });
const cut = () => act("look", { cut: $("cut-on").checked ? Number($("cut").value) : null });
$("cut").oninput = () => { $("cut-on").checked = true; cut(); };
$("cut-on").onchange = cut;
$("pick").onclick = () => act("pick", { frames: [$("first").value, $("second").value] });
$("apart").onclick = () => act("look", { mode: "apart" });
$("put").onclick = () => act("look", { mode: "place" });
$("look").onclick = () => act("look", { mode: "edge" });
$("adding").ontoggle = suggest;
$("decided").ontoggle = log;
document.addEventListener("keydown", pressed);
if (hasWebGl()) {
  $("scene").onload = () => $("scene").contentWindow.addEventListener("keydown", pressed, true);
} else {
  $("scene").remove();
  $("no-webgl").hidden = false;
}
ask("state").then(show, (error) => tell(error.message));
const events = new EventSource("events");
events.onmessage = (event) => show(JSON.parse(event.data));
events.onerror = () => tell("the review does not answer: is hodge review still running? Every decision so far is kept.");
events.onopen = () => tell("");
