// ---- Calls to the program that serves this page, with progress ----

const FRAME_MAX_PX = Math.max(360, window.innerHeight - 375); // below the readings, above the legend and a row of buttons
const SHARPENS = true;
let progressed = () => {};
canCallTools = true;

const running = new Set(); // calls about the current photograph
const leave = () => running.forEach((aborter) => aborter.abort());

async function request(method, params) {
  const aborter = new AbortController();
  if (params.arguments.image) running.add(aborter);
  try {
    return await answer(params, aborter.signal, (...progress) => progressed(...progress));
  } finally {
    running.delete(aborter);
  }
}

const UI = { "io.modelcontextprotocol/ui": { mimeTypes: ["text/html;profile=mcp-app"] } };
const META = {
  progressToken: 1,
  "io.modelcontextprotocol/protocolVersion": "2026-07-28",
  "io.modelcontextprotocol/clientInfo": { name: "vehanchor-view", version: "1" },
  "io.modelcontextprotocol/clientCapabilities": { extensions: UI },
};

// The program answers by events, each one line of JSON: progress, then the result.
async function answer(params, signal, report = () => {}) {
  const response = await fetch("mcp", {
    method: "POST", signal,
    headers: {
      "content-type": "application/json", accept: "application/json, text/event-stream",
      "mcp-protocol-version": "2026-07-28", "mcp-method": "tools/call", "mcp-name": params.name,
    },
    body: JSON.stringify({ jsonrpc: "2.0", id: 1, method: "tools/call", params: { ...params, _meta: META } }),
  });
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    rest += done ? "\n" : value;
    const lines = rest.split("\n");
    rest = lines.pop();
    for (const line of lines) {
      const at = line.indexOf("{"); // after "data:" in a stream
      if (at < 0) continue;
      const { params: progress, result, error } = JSON.parse(line.slice(at));
      if (result) return result;
      if (error) throw new Error(error.message);
      report(progress.progress, progress.message);
    }
    if (done) throw new Error("the program has ended. Start 'vehanchor view' again");
  }
}
