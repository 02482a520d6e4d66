"""MCP server of VehAnchor: the library as stateless tools over stdio and HTTP."""
