"""Tables and figures in, one HTML page out that stands alone: its pictures are inside it, nothing is fetched."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence

from training.paper_figures import Picture
from training.paper_scores import Results
from training.paper_tables import (
    BASELINE,
    NETWORK,
    Line,
    ablation_html,
    ablation_lines,
    comparison_html,
    latex_text,
    lines_of,
    ways_html,
)

_CSS = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1f2328; --soft: #59636e; --line: #d6dae0; --tint: #f4f6f8;
  --ours: #eef4fb; }
@media (prefers-color-scheme: dark) { :root { --paper: #161a20; --ink: #e3e6ea; --soft: #9aa4b0; --line: #3a404a;
  --tint: #1e242c; --ours: #1c2836; } figure img { filter: brightness(.88); } }
* { box-sizing: border-box; }
body { background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; max-width: 78rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin: 0 0 .5rem; } h2 { font-size: 1.25rem; margin: 2.4rem 0 .4rem; }
h3 { font-size: 1.02rem; margin: 1.8rem 0 .4rem; }
.verdict { background: var(--tint); border-left: .3rem solid #0072b2; padding: .8rem 1.1rem; }
.verdict p { margin: .25rem 0; }
.soft, figcaption { color: var(--soft); font-size: .9rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .3rem .5rem; border-bottom: 1px solid var(--line); vertical-align: top;
  white-space: nowrap; }
th { font-weight: 600; color: var(--soft); vertical-align: bottom; white-space: normal; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
tr.first td { border-top: 2px solid var(--soft); }
tr.network td { background: var(--ours); } tr.reference td { color: var(--soft); }
td.best { font-weight: 700; } td .soft { font-weight: 400; font-size: .8em; }
.paper, .papers { color: #b3541e; } td .paper { display: block; font-weight: 400; font-size: .88em; }
@media (prefers-color-scheme: dark) { .paper, .papers { color: #e8a06a; } }
figure { margin: 0; } figure img { max-width: 100%; height: auto; display: block; background: #ffffff;
  border: 1px solid var(--line); border-radius: .3rem; }
nav a { margin-right: 1rem; color: inherit; }
li { margin: .25rem 0; }
"""


def page_of(found: Results, pictures: Sequence[Picture]) -> str:
    """The whole page."""
    about = found.about
    lines = [line for line in lines_of(found.rows, 2) if line.label == "Ours"]
    counts = [_counts_text(line.rows[0]) for line in lines]
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        f"<title>PointFlowNet: tables and figures</title><style>{_CSS}</style></head><body>",
        "<h1>PointFlowNet: the paper's tables and figures</h1>",
        f'<p class="soft">K: {html.escape(about["data"]["K"])}, AK: {html.escape(about["data"]["AK"])}; '
        f"{_limit_text(about['limit'])}. Boxes that baselines follow: {_boxes_text(found)}. "
        f"{html.escape(_machine_text(found))}</p>",
        f'<div class="verdict">{"".join(f"<p>{html.escape(text)}</p>" for text in verdicts(found))}</div>',
        '<nav class="soft"><a href="#ablation">Table 1</a><a href="#comparison">Table 2</a><a href="#ways">Flow three '
        'ways</a><a href="#figures">Figures</a><a href="#how">How it was done</a></nav>',
        '<h2 id="ablation">Table 1: what augmentation does (validation splits)</h2>',
        _legend(),
        ablation_html(found.rows),
        f'<p class="soft">{html.escape(_ablation_note(found))}</p>',
        '<h2 id="comparison">Table 2: comparison with baselines (test splits)</h2>',
        comparison_html(found.rows),
        f'<p class="soft">{html.escape(" ".join(counts))} Grey rows are references and no methods. A row marked '
        "&ldquo;only&rdquo; is of fewer pairs than the others and takes no part in the bold figures.</p>",
        '<h2 id="ways">Direct scene flow against rigid motions</h2>',
        ways_html(found.rows),
        '<p class="soft">The paper found no significant difference in accuracy, and flow from rigid motions '
        f"smoother. {html.escape(_ways_text(found))} Scatter: of the error within a car, root mean square about its "
        "mean, mean over cars.</p>",
        '<h2 id="figures">Figures</h2>',
        *(_figure_html(picture) for picture in pictures),
        '<h2 id="how">How it was done, and what it cannot say</h2>',
        _method_html(found),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def verdicts(found: Results) -> list[str]:
    """What the tables say about the paper's two claims, in a sentence each."""
    out = []
    table1 = {(line.eval_set, line.trained_on): line for line in ablation_lines(found.rows)}
    plain, mixed = (_fg(table1.get(("K+AK", on))) for on in ("K", "K+AK"))
    steps = {row["step"] for line in table1.values() for row in line.rows}
    if plain is not None and mixed is not None:
        out.append(
            f"Augmentation (Table 1, K+AK): training on K+AK takes the foreground error from {plain:.2f} m to "
            f"{mixed:.2f} m, {mixed / plain:.2f} times; in the paper from 0.58 m to 0.28 m, 0.48 times."
            + ("" if len(steps) < 2 else " But their runs had different numbers of steps: not the data alone.")
        )
    elif ("K+AK", "K") not in table1:
        out.append("Augmentation (Table 1): no run trained on K was given, so there is nothing to compare with.")
    else:
        out.append("Augmentation (Table 1): the validation splits have no car in the grid, so nothing can be said.")
    lines = [line for line in lines_of(found.rows, 2) if line.eval_set == "K+AK"]
    ours = _fg(next((line for line in lines if line.label == "Ours"), None))
    rivals = [(value, line.label) for line in lines if line.kind == BASELINE and line.contends
              if (value := _fg(line)) is not None]  # fmt: skip
    if ours is not None and rivals:
        best, label = min(rivals)
        out.append(
            f"Comparison (Table 2, K+AK): our foreground error is {ours:.2f} m, the best baseline's {best:.2f} m "
            f"({label}); in the paper 0.34 m and 0.60 m (Dewan et al.)."
        )
    return out


def _ways_text(found: Results) -> str:
    """Whether that holds here, on K+AK."""
    ways = {line.rows[0]["method"]: line for line in lines_of(found.rows, 2)
            if line.kind == NETWORK and line.eval_set == "K+AK"}  # fmt: skip
    direct, moved = (_fg(ways.get(name)) for name in ("direct", "object"))
    rough, smooth = (
        None if one is None else one.figure("spread", "mean") for one in map(ways.get, ("direct", "object"))
    )
    if direct is None or moved is None or rough is None or smooth is None:
        return "Here there are no cars to tell."
    return (
        f"Here, on K+AK, a car's flow from its one motion is off by {moved:.2f} m where the direct flow is by "
        f"{direct:.2f} m, and scatters by {smooth.mean:.3f} m instead of {rough.mean:.3f} m. "
        "Points of a car that is not found, or outside the box that is, move with the ego-motion alone as object flow."
    )


def captions_of(found: Results) -> tuple[str, str]:
    """Of the two LaTeX tables."""
    data = found.about["data"]
    names = f"K: \\texttt{{{latex_text(data['K'])}}}, AK: \\texttt{{{latex_text(data['AK'])}}}"
    return (
        f"{{\\bf Ablation Study}} on our validation splits ({names}). In grey: the paper's figures.",
        f"{{\\bf Comparison to Baselines}} on our test splits ({names}). In grey: the paper's figures.",
    )


def _legend() -> str:
    return (
        '<p class="soft">Upper figure: ours, over several runs mean (least to largest); <span class="papers">'
        "below: the paper's</span>, which are of KITTI and of networks trained for days. Bold: the best of ours on a "
        "set. Object translation is that of the motion in LiDAR coordinates, which the paper's figures fit; "
        "&ldquo;object centre&rdquo; is that of the car's centre.</p>"
    )


def _ablation_note(found: Results) -> str:
    rows = [row for row in found.rows if row["table"] == 1]
    steps = {(row["trained_on"], row["step"]) for row in rows}
    if len({step for _, step in steps}) > 1:
        said = ", ".join(f"{on}: {step:,}" for on, step in sorted(steps))
        return (
            f"The runs were trained for different numbers of steps ({said}): what differs is not the data alone. "
            "make table1 trains both alike, with three seeds."
        )
    return _counts_text(rows[0])


def _counts_text(row: Mapping[str, object]) -> str:
    return (
        f"{row['eval_set']}: {row['pairs']:,} pairs, {row['fg_points']:,} foreground and {row['bg_points']:,} "
        f"background points, {row['objects']:,} cars to find."
    )


def _figure_html(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode()
    title = html.escape(picture.title)
    return (
        f'<h3 id="{picture.path.stem}">{title}</h3><figure><img alt="{title}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def _method_html(found: Results) -> str:
    about = found.about
    runs = ", ".join(f"{run['name']} (on {run['trained_on']}, step {run['step']:,})" for run in about["runs"])
    boxes = (
        "Baselines follow the true boxes of all cars, the network its own detections: its object errors are over the "
        "cars that it found, theirs over all."
        if about["boxes"] == "truth"
        else f"Baselines follow the network's detections (run {about['boxes_of']}), so that object errors are over the "
        "same true positives."
    )
    texts = (
        f"Runs: {runs}.",
        found.rules.as_text().replace("\n", " "),
        boxes,
        "Ego-motion and objects: means over pairs and over cars. A point for which a method has no estimate moves with "
        "its ego-motion; coverage is the share of the judged points with an estimate. The paper scores Dewan et al. on "
        "their own points alone: the JSON has those figures under `given_only`.",
        "s / pair: median wall time of the method alone. Detections are given to the baselines; the network's time "
        "is from the pair in memory to its prediction, voxels included. Three lines of ours are one prediction.",
        "K+AK is the plain and the augmented pairs together. " + f"Scored: {_limit_text(about['limit'])}.",
        "Image-based scene flow (ISF, Fig. 1) is out of scope: nothing here sees a camera image.",
    )
    return _list(texts)


def _list(texts: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(text)}</li>" for text in texts) + "</ul>"


def _limit_text(limit: int | None) -> str:
    return (
        "all pairs of each split" if limit is None else f"at most {limit} pairs of each set and split, spread over it"
    )


def _boxes_text(found: Results) -> str:
    return "the true ones" if found.about["boxes"] == "truth" else "the network's"


def _machine_text(found: Results) -> str:
    machine = found.about["machine"]
    where = (
        machine["device"]
        if machine["device"] != "cpu"
        else f"{machine['threads']} thread" + "s" * (machine["threads"] > 1)
    )
    jobs = machine["jobs"]
    beside = "" if jobs == 1 else f", the baselines in {jobs} processes side by side, a thread each"
    return f"Times on {machine['processor']}, {machine['cores']} cores; the network on {where}{beside}."


def _fg(line: Line | None) -> float | None:
    one = None if line is None else line.figure("fg_epe")
    return None if one is None else one.mean
