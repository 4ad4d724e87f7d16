"""The seven commands: the only place that knows click, streams and exit codes."""
