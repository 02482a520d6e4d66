"""One call from its acceptance to its answer, whatever the tool."""
