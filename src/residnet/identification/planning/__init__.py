"""Which manoeuvre to run next: what each would tell about the parameters of a refitted baseline."""
