"""robotctl, the operator's command line: standard library only, so that it starts in tens of milliseconds."""
