"""Colours of curves: *sentinels* that the finished SVG turns into CSS variables of the page.

The page's style sheet gives them their light, dark and printed values. The palette is that of Okabe and Ito
(2008), which people with any colour-vision deficiency can tell apart.
"""

INK, GRID, MUTED = "#010101", "#010102", "#010103"
MEASURED, SIMULATED, ONE_MATERIAL, TRUTH = "#010104", "#010105", "#010106", "#010107"
THIRD = "#010108"
FITTED, HELD_OUT = SIMULATED, ONE_MATERIAL
# The variable of the page for each sentinel, and its colour in the light theme of report.css, for drawings
# that leave the page.
VARIABLES = {
    INK: ("var(--ink)", "#1c2126"),
    GRID: ("var(--grid)", "#e3e5e8"),
    MUTED: ("var(--muted)", "#6a737c"),
    MEASURED: ("var(--measured)", "#1c2126"),
    SIMULATED: ("var(--simulated)", "#0072b2"),
    ONE_MATERIAL: ("var(--one-material)", "#c45500"),
    TRUTH: ("var(--truth)", "#00795a"),
    THIRD: ("var(--third)", "#cc79a7"),
}
