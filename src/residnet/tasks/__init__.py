"""The kinds of run; `residnet.tasks.registry.load_task` reads the one that a config describes."""
