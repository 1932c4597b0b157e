"""What others found where a socket presses, by region: to be read beside a result, without a verdict.

Only findings that the cited abstracts state. Pressures in kPa, which depend on sensor, socket and activity,
and thresholds of pain stand in the papers alone: no abstract gives them by region.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from ..results.socket import PublishedFindings

WHOLE = "the limb"


@dataclass(frozen=True)
class PublishedFinding:
    """What was found over some regions, how, and by whom."""

    regions: tuple[str, ...]
    found: str
    method: str
    source: str


SANDERS_1997 = "Sanders et al., J Rehabil Res Dev 1997, 34:19"
FINDINGS = (
    PublishedFinding(
        ("tibial crest", "distal tibia", "anterior middle", "anterior distal"),
        "the largest pressure and shear of stance, in its first half",
        "measured at 13 sites, walking, 2 persons, total-contact patellar-tendon-bearing sockets",
        SANDERS_1997,
    ),
    PublishedFinding(
        ("tibial crest",),
        "the skin across its distal part seemed to be in tension at both peaks of the load along the shank",
        "measured at 13 sites, walking, 2 persons, total-contact patellar-tendon-bearing sockets",
        SANDERS_1997,
    ),
    PublishedFinding(
        ("lateral middle", "posterior proximal"),
        "the directions of shear suggest that soft tissue moves towards the brim under load",
        "measured at 13 sites, walking, 2 persons, total-contact patellar-tendon-bearing sockets",
        SANDERS_1997,
    ),
    PublishedFinding(
        ("fibular head",),
        "a thicker gel liner lowers the peak pressure by 26 % (standard deviation 21 %)",
        "measured, walking, liners of two uniform thicknesses, persons with a transtibial amputation",
        "Boutwell et al., J Rehabil Res Dev 2012, 49:227",
    ),
    PublishedFinding(
        ("anterior middle", "posterior middle", "medial middle"),
        "peaks are 34 % larger in front, 24 % behind and 7 % medially with a sealing liner than another; "
        "laterally no difference",
        "measured, walking on the level, 9 persons, each with a prosthesis of either kind",
        "Ali et al., Clin Biomech 2012, 27:943",
    ),
    PublishedFinding(
        ("medial proximal", "lateral proximal"),
        "in front of them, the largest pressure in the second half of stance",
        "measured at 13 sites, walking, 2 persons, total-contact patellar-tendon-bearing sockets",
        SANDERS_1997,
    ),
    PublishedFinding(
        ("patellar tendon",),
        "the load grows where the limb shrinks, as at the distal end",
        "measured monthly at 13 sites, walking, 2 persons who lost weight",
        "Sanders et al., Prosthet Orthot Int 2002, 26:243",
    ),
    PublishedFinding(
        ("patellar tendon",),
        "a bar moved by 10 mm either way changed pressures elsewhere by nothing significant",
        "measured, 10 men, patellar-tendon-bearing sockets",
        "Abu Osman et al., Med Eng Phys 2010, 32:760",
    ),
    PublishedFinding(
        ("distal fibula",),
        "pressure concentrates there and near the brim with patellar-tendon bearing; it is lower and more "
        "even in a hydrostatic socket",
        "simulated by finite elements",
        "Moo et al., Acta Bioeng Biomech 2009, 11(4)",
    ),
    PublishedFinding(
        (WHOLE,),
        "pressures are distributed alike in pressure-cast and in hand-cast patellar-tendon-bearing sockets, "
        "and higher in the former",
        "measured over more than 90 % of the socket, walking, 48 persons",
        "Dumbleton et al., J Rehabil Res Dev 2009, 46:405",
    ),
)


def select_published_findings(regions: Collection[str]) -> list[PublishedFindings]:
    """The findings over any of the ``regions``, or over the whole limb, as they are stored."""
    rows = []
    for finding in FINDINGS:
        covered = [name for name in finding.regions if name in regions or name == WHOLE]
        if covered:
            rows.append(PublishedFindings.model_validate(replace(finding, regions=tuple(covered))))
    return rows
