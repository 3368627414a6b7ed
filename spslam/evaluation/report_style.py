"""The style sheet of the report, for light and dark screens and for print."""

STYLE = """
:root { --ink: #1b1f24; --faint: #667080; --line: #dfe3e8; --page: #ffffff; --card: #f5f7f9;
  --estimate: #1f6feb; --ground-truth: #9aa3ad; --lost: #d1242f; --tracking: #1f6feb; --encoding: #1a9988;
  --mapping: #e0822d; --rest: #aab2bd; --mesh: #8957c9; --r: #d1495b; --f: #2a8c6a; --u: #7a5bc4; --total: #1b1f24; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ed; --faint: #97a1ad; --line: #333b45; --page: #14181d;
  --card: #1d232a; --ground-truth: #7d8793; --total: #e4e8ed; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 26px; margin: 0; } h2 { font-size: 18px; margin: 36px 0 4px; }
p { color: var(--faint); margin: 0 0 12px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(130px, 1fr)); gap: 10px; margin: 18px 0 0; }
.tiles div { background: var(--card); border-radius: 8px; padding: 10px 14px; }
.tiles dt { color: var(--faint); font-size: 13px; }
.tiles dd { margin: 0; font-size: 21px; font-weight: 600; white-space: nowrap; font-variant-numeric: tabular-nums; }
figure { margin: 0; } img { display: block; width: 100%; border-radius: 6px; background: #fff; }
.map img { width: auto; max-width: 100%; max-height: 640px; }
figcaption { color: var(--faint); font-size: 13px; padding: 4px 0 8px; }
.row { display: flex; gap: 10px; } .row figure { flex: 1 1 0; min-width: 0; }
svg { display: block; width: 100%; height: auto; margin: 10px 0 0; }
.line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.grid { stroke: var(--line); stroke-width: 1; fill: none; }
.scale-bar { stroke: var(--ink); stroke-width: 2.5; }
.label { fill: var(--faint); font-size: 12px; } .end { text-anchor: end; } .middle { text-anchor: middle; }
.on-bar { fill: #fff; font-size: 13px; font-weight: 600; text-anchor: middle; }
path.lost { stroke: var(--lost); stroke-width: 2; opacity: .25; }
.ring { fill: var(--page); stroke-width: 2; }
.line.ground-truth { stroke-width: 3; opacity: .75; } .line.total { stroke-width: 2; }
.legend { display: flex; flex-wrap: wrap; gap: 4px 18px; list-style: none; margin: 6px 0 0; padding: 0;
  font-size: 13px; }
.key { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 6px; vertical-align: -1px; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; max-width: 640px; }
th, td { text-align: left; font-weight: 400; padding: 3px 12px 3px 0; border-bottom: 1px solid var(--line); }
th { color: var(--faint); width: 45%; }
summary { cursor: pointer; font-size: 18px; font-weight: 600; margin-top: 36px; }
pre { background: var(--card); border-radius: 8px; padding: 14px; overflow-x: auto; font-size: 13px; }
""" + "".join(
    f".line.{kind}, .ring.{kind} {{ stroke: var(--{color}); }} "
    f".dot.{kind}, .bar.{kind} {{ fill: var(--{color}); }} .key.{kind} {{ background: var(--{color}); }}\n"
    for kind, color in (
        *(
            (name, name)
            for name in ("estimate", "ground-truth", "lost", "tracking", "encoding", "mapping", "rest", "mesh")
        ),
        ("r", "r"),
        ("f", "f"),
        ("u", "u"),
        ("total", "total"),
    )
)
