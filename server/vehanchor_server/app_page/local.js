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

// The program answers with JSON lines: progress, then the result.
async function answer(params, signal, report = () => {}) {
  const response = await fetch("call", {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(params), signal,
  });
  if (!response.ok) throw new Error(await response.text());
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    rest += value ?? "";
    const lines = rest.split("\n");
    rest = lines.pop();
    for (const line of lines) {
      const { progress, message, result } = JSON.parse(line);
      if (result) return result;
      report(progress, message);
    }
    if (done) throw new Error("the program has ended. Start 'vehanchor view' again");
  }
}
