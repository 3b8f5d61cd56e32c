"""The report page's style sheet: light and dark, on a phone and on paper."""

from typing import Final

STYLE: Final = """
:root {
  --paper: #fbfbf9; --card: #ffffff; --ink: #1d232b; --soft: #5c6672; --line: #e3e5e8; --grid: #d9dce0;
  --arm0: #d1601f; --arm1: #1a6fb5; --arm2: #3d8b5f; --arm3: #8f5bb3; --arm4: #8a7a1e; --arm5: #b0447a;
  --hazard: #6f7fd6; --goal: #2c8f4e; --vase: #2aa5ad; --mark: #e0a100; --bad: #d0202e;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #15181c; --card: #1d2126; --ink: #e6e8eb; --soft: #9aa4af; --line: #31373f; --grid: #3a4149;
    --arm0: #f28e52; --arm1: #62b0ef; --arm2: #6cc490; --arm3: #c394e6; --arm4: #cfbd55; --arm5: #ea86b6;
    --hazard: #8796f0; --goal: #5cc981; --vase: #56cdd4; --mark: #ffc93c; --bad: #ff5a64;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
main { max-width: 1040px; margin: 0 auto; padding: 32px 20px 64px; }
h1 { font-size: 28px; margin: 0; letter-spacing: -0.01em; }
h2 { font-size: 19px; margin: 40px 0 12px; }
header p, figure + p, li { color: var(--soft); }
header p { margin: 4px 0 0; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(210px, 1fr)); gap: 14px; }
header { margin-bottom: 26px; }
.card, figure, pre {
  margin: 0; padding: 16px 18px;
  background: var(--card); border: 1px solid var(--line); border-radius: 10px;
}
.card h3 { font-size: 14px; font-weight: 600; margin: 0; min-height: 2.6em; line-height: 1.3; }
.card h3 { color: var(--soft); }
.card p { margin: 0; font-size: 14px; }
.card .value { font-size: 36px; font-weight: 700; line-height: 1.25; font-variant-numeric: tabular-nums; }
.card .other { color: var(--soft); }
svg { width: 100%; height: auto; display: block; }
svg text { font-family: inherit; }
.keys { font-size: 14px; padding: 4px 6px; }
.key { display: inline-block; margin-right: 18px; white-space: nowrap; }
.key i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 6px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 15px; }
th, td { text-align: right; padding: 6px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
tbody th { font-weight: 400; }
.condition th { font-weight: 700; padding-top: 18px; }
small { color: var(--soft); font-size: 13px; }
details { margin: 10px 0; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; }
"""
