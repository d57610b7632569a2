"""The kinds of run; `residnet.tasks.loading.load_task` reads the one that a config describes."""
