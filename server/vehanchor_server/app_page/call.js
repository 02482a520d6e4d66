// ---- State: one call of one tool, and what was measured by clicks since ----

const PANEL_KEY = "vehanchor/panel";
const call = { tool: undefined, arguments: undefined, result: undefined, measured: [] };
let canCallTools = false;
const exporters = []; // rows below the picture; only a page that may write files has any
