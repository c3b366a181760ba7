"""A table of runs over seeds: mean and half the range of PSNR (with several seeds), the mean of ssim_2d, the longest command.

usage: spread.py PATTERN ROWS COLUMNS SEEDS

PATTERN is the name of a record with {row}, {column} and {seed} in it; the rest are lists with spaces between.
"""
import json, statistics, sys

pattern, rows, columns, seeds = sys.argv[1], *(text.split() for text in sys.argv[2:])
print("| | " + " | ".join(columns) + " |\n|---" + "|---" * len(columns) + "|")
for row in rows:
    cells = []
    for column in columns:
        runs = [json.load(open(pattern.format(row=row, column=column, seed=seed))) for seed in seeds]
        psnr = [run["scores"]["psnr"] for run in runs]
        ssim = statistics.mean(run["scores"]["ssim_2d"] for run in runs)
        longest = max(run["total_s"] for run in runs)
        range_ = f" ± {(max(psnr) - min(psnr)) / 2:.2f}" if len(seeds) > 1 else ""
        time = f"{longest:.0f} s" if longest >= 20 else f"{longest:.1f} s"
        cells.append(f"{statistics.mean(psnr):.2f} dB{range_}, {ssim:.3f}, {time}")
    print(f"| {row} | " + " | ".join(cells) + " |")
