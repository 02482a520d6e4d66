// ---- Photographs: the folder's and dropped ones ----

const known = new Map(); // by path: the button, and the call with what was measured since, if any
const NAME_END = 12;
let chosen;
let nextPage;

const nameOf = (path) => path.split(/[\\/]/).pop();
const count = () => {
  byId("count").textContent = counted(known.size, "photograph");
};

function listPhotograph(path, first = false) {
  if (known.has(path)) return;
  const mark = html("span", { class: "mark", "aria-hidden": "true" });
  const thumbnail = html("span", { class: "thumbnail", "aria-hidden": "true" });
  const name = nameOf(path);
  const cut = Math.max(name.length - NAME_END, 0); // shortened in the middle: names of one flight differ at their ends
  const words = html("span", { class: "name" }, html("span", {}, name.slice(0, cut)), html("span", {}, name.slice(cut)));
  const button = html("button", { type: "button", title: path, on: { click: () => choose(path) } }, mark, thumbnail, words);
  known.set(path, { button, mark, thumbnail });
  byId("photographs")[first ? "prepend" : "append"](html("li", {}, button));
  awaitThumbnail(path, thumbnail);
  count();
}

const imageAt = (path) => ({ kind: "path", path });
const askedFor = (path, region) => ({ image: imageAt(path), ...(region ? { region } : {}) });

async function listPage(page) {
  byId("more").hidden = true;
  nextPage = undefined;
  const { structuredContent: listed } = await request("tools/call", { name: "view_image", arguments: { page } });
  listed.images.forEach((path) => listPhotograph(path));
  if (!listed.next_page) return;
  nextPage = listed.next_page;
  byId("more").hidden = false;
  byId("more").onclick = () => listPage(nextPage);
}

// Stop the calls about the current photograph, and keep what was measured.
function leavePhotograph() {
  leave();
  if (chosen && call.result) {
    known.get(chosen).call = { ...call };
    markStatus(known.get(chosen), call.result);
  }
  call.result = undefined;
}

function markStatus({ mark }, result) {
  mark.className = `mark ${result.isError ? "failed" : result.structuredContent.status}`;
}

async function choose(path) {
  leavePhotograph();
  chosen = path;
  for (const [each, { button }] of known) button.setAttribute("aria-current", String(each === path));
  const region = byId("region").value;
  begin("estimate_gsd", askedFor(path, region));
  byId("sections").replaceChildren();
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  const bar = html("progress", { max: "100", "aria-label": "Progress of the measurement" });
  byId("sections").replaceChildren(bar);
  if (!known.get(path).call) showPreview(path, bar);
  progressed = (percent, message) => {
    if (chosen !== path || !bar.isConnected) return;
    bar.value = percent;
    say(`${nameOf(path)}: ${message}.`);
  };
  say(`Measuring ${nameOf(path)}.`);
  const result = await estimated(path, region);
  if (!result || chosen !== path) return;
  if (!result.isError) Object.assign(call, known.get(path).call);
  show(result);
}

// The estimate of a photograph, made once for a region; undefined if the call was left.
async function estimated(path, region) {
  const entry = known.get(path);
  if (entry.call && (entry.call.arguments.region ?? "") === region) return entry.call.result;
  let result;
  try {
    result = await request("tools/call", { name: "estimate_gsd", arguments: askedFor(path, region) });
  } catch (error) {
    if (error.name === "AbortError") return undefined;
    result = { isError: true, content: [{ type: "text", text: error.message }] };
  }
  if (!result.isError) entry.call = { arguments: askedFor(path, region), result };
  markStatus(entry, result);
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
byId("region").addEventListener("change", () => chosen && choose(chosen));
say("Drop aerial photographs here, or choose one from the list.");
byId("panel").setAttribute("aria-busy", "false");
listPage(1).then(() => {
  const wanted = decodeURIComponent(location.hash.slice(1)); // the photograph of the command line
  const first = known.has(wanted) ? wanted : known.keys().next().value;
  if (first && !chosen) choose(first);
}, (error) => fail(error.message));
