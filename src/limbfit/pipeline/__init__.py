"""A study to stored artefacts, stage by stage: run, status, check, simulate, report, and the demo."""
