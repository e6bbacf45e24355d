"""Learning curves of runs as one small CSV and one SVG: `python benchmarks/learning_curves.py NAME RUN ...`.

It writes NAME.csv and NAME.svg to docs/reference/curves: the success rate of each run over its environment steps,
during training, with exploration. The label of a run is its seed.
"""

import csv
import json
import sys
from pathlib import Path

METRIC = "Train/success_rate"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 640, 300, 50, 90, 20, 45


def curve(run):
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    seed = json.loads((run / "run.json").read_text())["seed"]
    return seed, [(row["step"], row.get(METRIC, 0.0)) for row in rows]


def table(curves):
    steps = [step for step, _ in curves[0][1]]
    columns = [dict(points) for _, points in curves]
    header = ["step", *(f"seed {seed}" for seed, _ in curves)]
    return [header, *([step, *(f"{column[step]:.3f}" for column in columns)] for step in steps)]


def drawing(curves):
    last = max(points[-1][0] for _, points in curves)
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM

    def place(step, value):
        return f"{LEFT + (right - LEFT) * step / last:.1f},{bottom - (bottom - TOP) * value:.1f}"

    lines = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif">']
    lines += [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>']
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = place(0, value).partition(",")[2]
        lines += [f'<line x1="{LEFT}" x2="{right}" y1="{y}" y2="{y}" stroke="#ddd"/>']
        lines += [f'<text x="{LEFT - 6}" y="{y}" font-size="11" text-anchor="end" dy="4">{value:g}</text>']
    for part in range(5):
        x, step = LEFT + (right - LEFT) * part / 4, last * part / 4
        lines += [f'<text x="{x}" y="{bottom + 18}" font-size="11" text-anchor="middle">{step / 1e6:.2g} M</text>']
    middle = (LEFT + right) / 2
    lines += [f'<text x="{middle}" y="{HEIGHT - 8}" font-size="12" text-anchor="middle">environment steps</text>']
    for number, (seed, points) in enumerate(curves):
        colour, y = COLOURS[number % len(COLOURS)], TOP + 16 * number + 10
        path = " ".join(place(*point) for point in points)
        lines += [f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>']
        lines += [f'<text x="{right + 10}" y="{y}" font-size="12" fill="{colour}">seed {seed}</text>']
    return "\n".join([*lines, "</svg>", ""])


def main(name, *runs):
    curves = sorted(curve(Path(run)) for run in runs)
    folder = Path(__file__).parents[1] / "docs" / "reference" / "curves"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(table(curves))
    (folder / f"{name}.svg").write_text(drawing(curves))


if __name__ == "__main__":
    main(*sys.argv[1:])
