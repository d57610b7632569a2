"""From csv logs to models that run freely, and one track of them: fifteen lines."""

import residnet

channels = {"x": ("north", "m"), "y": ("east", "m"), "psi": ("heading", "deg")}
channels |= {"u": ("surge", "m/s"), "v": ("sway", "m/s"), "r": ("yaw rate", "deg/s")}
channels |= {"n_port": ("port", "rpm"), "n_stbd": ("starboard", "rpm")}
logs = residnet.read_logs("trials/*.csv", channels=channels, time="time")
print(residnet.inspect(logs))
data = residnet.prepare(logs, inputs=["n_port", "n_stbd"])
models = residnet.fit(data, baseline="regressors", heads=["plsr", "lstm"], progress=print)
table = residnet.metrics(models, split="test")
print(table[["model", "protocol", "diverged", "nrmse_mean", "position_error_end"]])
print("best on the validation logs:", residnet.select_model(models).name)
runs = residnet.free_run(models, data)
runs.plot_track().savefig("track.png")
