// ---- Photographs: the folder's and dropped ones ----

const known = new Map(); // by path: the button, and the call with what was measured since, if any
let chosen;
let allListed; // a promise, while there are more pages

const partsOf = (path) => path.split(/[\\/]/);
const nameOf = (path) => partsOf(path).pop();

// The ends of a path, from its name to all of it, and how many photographs have each of them.
const endsOf = (path) => partsOf(path).map((_, i, parts) => parts.slice(-i - 1).join("/"));
const counts = new Map();

// The name of a photograph, with so many of its folders that no other one is called the same.
const labelOf = (path) => endsOf(path).find((end) => counts.get(end) === 1) ?? path;
function writeNames() {
  for (const [path, { words }] of known) if (words.textContent !== labelOf(path)) words.textContent = labelOf(path);
}

function listPhotograph(path, first = false) {
  if (known.has(path)) return;
  const mark = html("span", { class: "mark", "aria-hidden": "true" });
  const thumbnail = html("span", { class: "thumbnail", "aria-hidden": "true", "data-path": path });
  const words = html("span", { class: "name" });
  const entry = html("button", { type: "button", title: path, tabindex: known.size ? -1 : 0, on: { click: () => choose(path) } }, mark, thumbnail, words);
  known.set(path, { button: entry, mark, thumbnail, words });
  for (const end of endsOf(path)) counts.set(end, (counts.get(end) ?? 0) + 1);
  byId("photographs")[first ? "prepend" : "append"](html("li", {}, entry));
  seen.observe(thumbnail);
  byId("count").textContent = counted(known.size, "photograph");
}

const imageAt = (path) => ({ kind: "path", path });
const factsStated = () => {
  if (!chosen) measureAll();
  else if (call.result && !call.result.isError) measureWithFacts();
  else choose(chosen);
};
const shown = offerFacts;

const showChosen = (button) => {
  for (const { button: each } of known.values()) each.setAttribute("aria-current", String(each === button));
};

// The list is one stop of the Tab key: arrows move within it.
function stopAt(button) {
  for (const { button: each } of known.values()) each.tabIndex = each === button ? 0 : -1;
}
byId("photographs").addEventListener("keydown", (event) => {
  const buttons = [...byId("photographs").querySelectorAll("li:not([hidden]) button")];
  const next = buttons[buttons.indexOf(event.target) + { ArrowDown: 1, ArrowUp: -1 }[event.key]];
  if (!next) return;
  event.preventDefault();
  stopAt(next);
  next.focus();
});

function startOfCommonFolder(paths) {
  let folder = paths[0] ?? "";
  do folder = folder.slice(0, Math.max(folder.lastIndexOf("/"), 0));
  while (folder && !paths.every((path) => path.startsWith(`${folder}/`)));
  return folder.lastIndexOf("/") + 1;
}

function listMatching() {
  const words = byId("find").value.toLowerCase();
  // The folders above the one that all have in common are in every path: they find nothing.
  const start = startOfCommonFolder([...known.keys()]);
  for (const [path, { button }] of known) button.parentElement.hidden = !path.slice(start).toLowerCase().includes(words);
  stopAt(byId("photographs").querySelector("li:not([hidden]) button"));
}

// List all photographs, the pages after the first while the page is already in use.
async function listPages(page = 1) {
  const { structuredContent: listed } = await request("tools/call", { name: "page_image", arguments: { page } });
  for (const path of listed.images) listPhotograph(path);
  writeNames();
  allListed = listed.next_page ? listPages(listed.next_page).catch(() => { allListed = undefined; }) : undefined;
}

// Stop the calls about the current photograph, and keep what was measured.
function leavePhotograph() {
  leave();
  if (chosen && call.result) {
    known.get(chosen).call = { ...call };
    markStatus(chosen, call.result);
  }
  call.result = undefined;
}

function markStatus(path, result) {
  const { button: entry, mark } = known.get(path);
  const status = result.isError ? "failed" : result.structuredContent.status;
  mark.className = `mark ${status}`;
  entry.title = `${path}: ${STATUS[status]}`; // the mark in words
}

async function choose(path) {
  leavePhotograph();
  chosen = path;
  const entry = known.get(path);
  showChosen(entry.button);
  stopAt(entry.button);
  if (entry.call) {
    Object.assign(call, entry.call);
    show(call.result);
    if (factsOf(call.arguments) !== factsOf(statedFacts())) await measureWithFacts();
    return;
  }
  begin("estimate_gsd", withFacts({ image: imageAt(path) }));
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  const bar = html("progress", { max: "100", "aria-label": "Progress of the measurement" });
  byId("sections").replaceChildren(bar);
  showPreview(path, bar);
  const began = performance.now();
  progressed = (percent, message) => {
    if (chosen !== path || !bar.isConnected) return;
    bar.value = percent;
    say(`${nameOf(path)}: ${message}${timeLeft(began, percent / 100)}.`);
  };
  say(`Measuring ${nameOf(path)}.`);
  const result = await estimated(path);
  if (!result || chosen !== path) return;
  call.result = result;
  show(result);
}

// The estimate of a photograph, made once for the stated facts; undefined if the call was left.
async function estimated(path) {
  const entry = known.get(path);
  const asked = withFacts({ ...entry.call?.arguments, image: imageAt(path) });
  if (entry.call && factsOf(entry.call.arguments) === factsOf(asked)) return entry.call.result;
  let result;
  try {
    result = await request("tools/call", { name: "estimate_gsd", arguments: asked });
  } catch (error) {
    if (error.name === "AbortError") return undefined;
    result = { isError: true, content: [{ type: "text", text: error.message }] };
  }
  if (!result.isError) entry.call = { tool: "estimate_gsd", arguments: asked, result, measured: [], corrections: undefined };
  markStatus(path, result);
  const source = pictureOf(result);
  if (source) showThumbnail(entry.thumbnail, source.url);
  return result;
}

async function take(files) {
  let first;
  for (const file of files) {
    say(`Reading ${file.name}.`);
    const response = await fetch(`photographs?name=${encodeURIComponent(file.name)}`, {
      method: "POST", headers: { "content-type": "application/octet-stream" }, body: file,
    }).catch(() => undefined);
    if (!response?.ok) {
      fail(response ? await response.text() : "The program has ended. Start 'vehanchor view' again.");
      continue;
    }
    const { path } = await response.json();
    listPhotograph(path, true);
    writeNames();
    first ??= path;
  }
  if (first) await choose(first);
}

// ---- Start ----

for (const [name, over] of [["dragenter", true], ["dragover", true], ["dragleave", false], ["drop", false]]) {
  window.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", over && event.dataTransfer.types.includes("Files"));
    if (name === "drop") take(event.dataTransfer.files);
  });
}
byId("files").addEventListener("change", (event) => take(event.target.files));
byId("all").addEventListener("click", measureAll);
byId("open").addEventListener("click", () => byId("files").click());
byId("find").addEventListener("input", listMatching);
byId("photographs").before(byId("facts"), byId("units"));
byId("units").hidden = false;
Object.assign(byId("facts"), { hidden: false, open: window.innerWidth > 760 });
say("Drop aerial photographs here, or choose one from the list.");
byId("panel").setAttribute("aria-busy", "false");
listPages().then(() => {
  const wanted = decodeURIComponent(location.hash.slice(1)); // the photograph of the command line
  const first = known.has(wanted) ? wanted : known.keys().next().value;
  if (first && !chosen) choose(first);
}, (error) => fail(error.message));
