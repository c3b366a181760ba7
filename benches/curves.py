"""Draws PSNR of finished runs against training time or steps, or their drift against epochs; runs of one name have one colour.

usage: curves.py [--steps | --drift] OUT.png TITLE NAME=RUN_FOLDER...     
"""
import json
import sys
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

arguments = sys.argv[1:]
if len(arguments) < 3:
    sys.exit(__doc__)
option = arguments.pop(0) if arguments[0].startswith("--") else "--seconds"
out, title, *runs = arguments
figure, panel = plt.subplots(figsize=(12, 8))
colours = {}
for run in runs:
    name, folder = run.split("=", 1)
    records = [json.loads(line) for line in open(f"{folder}/metrics.jsonl")]
    if option == "--drift":
        points = [(d["epoch"], d["mean_l1"]) for record in records for d in record.get("drift", [])]
    else:
        points = [(record[option.removeprefix("--").replace("steps", "step")], record["psnr"]) for record in records if "psnr" in record]
    if not points:
        continue
    [line] = panel.plot(*zip(*points), color=colours.get(name), label=None if name in colours else name)
    colours[name] = line.get_color()
labels = {"--seconds": ("seconds of training", "PSNR, dB"), "--steps": ("steps", "PSNR, dB"), "--drift": ("epochs", "drift (mean L1)")}
panel.set(title=title, xlabel=labels[option][0], ylabel=labels[option][1], yscale="log" if option == "--drift" else "linear")
panel.legend()
figure.savefig(out)
