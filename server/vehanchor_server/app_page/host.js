// ---- The host: JSON-RPC 2.0 over postMessage (MCP Apps, 2026-01-26) ----

const PROTOCOL_VERSION = "2026-01-26";
const FRAME_MAX_PX = 620; // absolute, because hosts make the window as high as the page
const SHARPENS = false; // each view of a part would be a call that the user must confirm
const waiting = new Map();
let lastId = 0;

// The page cannot know the host's origin; its messages have no secrets.
const send = (message) => window.parent.postMessage({ jsonrpc: "2.0", ...message }, "*");
const notify = (method, params = {}) => send({ method, params });
const request = (method, params) =>
  new Promise((resolve, reject) => {
    lastId += 1;
    waiting.set(lastId, { resolve, reject });
    send({ id: lastId, method, params });
  });

const answers = { ping: () => ({}), "ui/resource-teardown": () => ({}) };
const listeners = {
  "ui/notifications/tool-input": (params) => {
    begin(call.tool, params.arguments);
    if (!call.result) say("Measuring.");
  },
  "ui/notifications/tool-result": (result) => {
    call.result = result;
    show(result);
  },
  "ui/notifications/tool-cancelled": (params) => fail(`Cancelled${params.reason ? `: ${params.reason}` : ""}.`),
  "ui/notifications/host-context-changed": (context) => adopt(context),
};

window.addEventListener("message", ({ source, data }) => {
  if (source !== window.parent || data?.jsonrpc !== "2.0") return;
  if (data.method === undefined) {
    const { resolve, reject } = waiting.get(data.id) ?? {};
    waiting.delete(data.id);
    if (data.error) reject?.(new Error(data.error.message));
    else resolve?.(data.result);
  } else if (data.id === undefined) {
    listeners[data.method]?.(data.params ?? {});
  } else if (answers[data.method]) {
    send({ id: data.id, result: answers[data.method]() });
  } else {
    send({ id: data.id, error: { code: -32601, message: `unknown method ${data.method}` } });
  }
});

function adopt(context) {
  const root = document.documentElement;
  if (context.theme) root.dataset.theme = context.theme;
  for (const [name, value] of Object.entries(context.styles?.variables ?? {})) {
    if (name.startsWith("--") && value) root.style.setProperty(name, value);
  }
  const inset = context.safeAreaInsets;
  if (inset) document.body.style.padding = `${inset.top}px ${inset.right}px ${inset.bottom}px ${inset.left}px`;
  if (context.toolInfo) call.tool = context.toolInfo.tool.name;
}
