// ---- Photographs: the folder's and dropped ones ----

const known = new Map(); // by path: the button, and the result if any
let chosen;

const nameOf = (path) => path.split(/[\\/]/).pop();
const count = () => {
  byId("count").textContent = counted(known.size, "photograph");
};

function listPhotograph(path, first = false) {
  if (known.has(path)) return;
  const mark = html("span", { class: "mark", "aria-hidden": "true" });
  const button = html("button", { type: "button", title: path, on: { click: () => choose(path) } }, mark, html("span", {}, nameOf(path)));
  known.set(path, { button, mark });
  byId("photographs")[first ? "prepend" : "append"](html("li", {}, button));
  count();
}

async function listPage(page) {
  byId("more").hidden = true;
  const { structuredContent: listed } = await request("tools/call", { name: "view_image", arguments: { page } });
  listed.images.forEach((path) => listPhotograph(path));
  if (!listed.next_page) return;
  byId("more").hidden = false;
  byId("more").onclick = () => listPage(listed.next_page);
}

async function choose(path) {
  leave();
  chosen = path;
  for (const [each, { button }] of known) button.setAttribute("aria-current", String(each === path));
  const region = byId("region").value;
  call.arguments = { image: { kind: "path", path }, ...(region ? { region } : {}) };
  call.tool = "estimate_gsd";
  call.measured = [];
  byId("sections").replaceChildren();
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  const entry = known.get(path);
  const bar = html("progress", { max: "100", "aria-label": "Progress of the measurement" });
  byId("sections").replaceChildren(bar);
  progressed = (percent, message) => {
    if (chosen !== path || !bar.isConnected) return;
    bar.value = percent;
    say(`${nameOf(path)}: ${message}.`);
  };
  say(`Measuring ${nameOf(path)}.`);
  let result = entry.result?.region === region ? entry.result.result : undefined;
  try {
    result ??= await request("tools/call", { name: call.tool, arguments: call.arguments });
  } catch (error) {
    if (error.name === "AbortError") return;
    result = { isError: true, content: [{ type: "text", text: error.message }] };
  }
  if (!result.isError) entry.result = { region, result };
  entry.mark.className = `mark ${result.isError ? "failed" : result.structuredContent.status}`;
  if (chosen !== path) return;
  call.result = result;
  show(result);
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

for (const [name, over] of [["dragenter", true], ["dragover", true], ["dragleave", false], ["drop", false]]) {
  window.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", over && event.dataTransfer.types.includes("Files"));
    if (name === "drop") take(event.dataTransfer.files);
  });
}
byId("files").addEventListener("change", (event) => take(event.target.files));
byId("open").addEventListener("click", () => byId("files").click());
byId("region").addEventListener("change", () => chosen && choose(chosen));
say("Drop aerial photographs here, or choose one from the list.");
byId("panel").setAttribute("aria-busy", "false");
listPage(1).then(() => {
  const wanted = decodeURIComponent(location.hash.slice(1)); // the photograph of the command line
  if (known.has(wanted)) choose(wanted);
}, (error) => fail(error.message));
