"""The page that MCP App hosts show beside a tool's result."""
