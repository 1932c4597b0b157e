"""Published soft tissues, with citation, and how their laws were put into the one that is solved here.

Every law is a sum of Ogden terms ``c_k/m_k^2 (lt_1^m_k + lt_2^m_k + lt_3^m_k - 3)``, FEBio's convention: its
shear modulus of small strains is ``sum c_k / 2``. Only numbers that were found in print stand here; a tissue
whose law is not stated with its numbers is left out. ``relaxation`` is None where none was published: then
the study's own is used, as the paper does.
"""

from __future__ import annotations

from dataclasses import dataclass

from ...fe import Ogden
from ...fe.materials import PronyTerms

KPA = 1e-3  # MPa


@dataclass(frozen=True)
class PublishedTissue:
    """A tissue of the literature.

    Parameters
    ----------
    kind : ``skin`` or ``muscle``: beside which of a study's tissues it is shown.
    values : the numbers as printed.
    terms : (c_k in kPa, m_k) of the Ogden terms that they were put into.
    bulk_kPa : bulk modulus: 100 times ``c``, as in the paper, or times the shear modulus.
    relaxation : (gamma, tau in s) of ``G = 1 + gamma exp(-t/tau)``; None: not published; () : elastic.
    conversion : what was done to the numbers, in words.
    source : the citation, and where the numbers were taken from.
    """

    name: str
    kind: str
    values: str
    terms: tuple[tuple[float, float], ...]
    bulk_kPa: float
    relaxation: tuple[float, float] | tuple[()] | None
    conversion: str
    source: str

    def material(self, relaxation: PronyTerms) -> Ogden:
        """The tissue for the solver, MPa; ``relaxation`` is taken where none was published."""
        published = (self.relaxation,) if self.relaxation else ()
        used = relaxation if self.relaxation is None else published
        shear = 0.5 * sum(c for c, _ in self.terms)
        return Ogden(
            tuple((c * KPA, m) for c, m in self.terms),
            used,
            kappa_ratio=self.bulk_kPa / shear,
        )


_FIRST_ORDER = (
    "c and m of FEBio's first-order Ogden, c/m² Σ(λᵐ − 1), the law that the paper names: the shear modulus "
    "of small strains is c/2"
)
_SECOND_ORDER = "the law of limbfit, c/m² Σ(λᵐ + λ⁻ᵐ − 2); γ read without the unit that the paper prints"
_PAPER = "Sengeh, Moerman, Petron and Herr, J. Mech. Behav. Biomed. Mater. 59 (2016) 379"
_LIM = (
    "Lim, Hong, Chen and Weerasooriya 2011, pig skin in tension, as quoted by Sengeh et al. 2016 [their 44]"
)
_AFFAGARD = (
    "Affagard et al., human thigh muscles in vivo, as quoted by Dao and Ho Ba Tho, Appl. Bionics Biomech. "
    "2018, 7631818, table 2"
)
_NEO_HOOKEAN = "neo-Hookean C10 (I1 − 3): one Ogden term, m = 2 and c = 4 C10; shear modulus 2 C10"
_NO_RELAXATION = "; no relaxation published: that of the study's own tissue"

PUBLISHED = (
    PublishedTissue(
        "residuum, skin–adipose (Sengeh 2016)", "skin", "c = 5.22 kPa, m = 4.79, γ = 3.57, τ = 0.32 s",
        ((5.22, 4.79), (5.22, -4.79)), 522.0, (3.57, 0.32), _SECOND_ORDER, f"{_PAPER}, table 1",
    ),
    PublishedTissue(
        "pig skin, along the spine (Lim 2011)", "skin", "c = 20 kPa, m = 11",
        ((20.0, 11.0),), 2000.0, None, _FIRST_ORDER + _NO_RELAXATION, _LIM,
    ),
    PublishedTissue(
        "pig skin, across the spine (Lim 2011)", "skin", "c = 8 kPa, m = 7",
        ((8.0, 7.0),), 800.0, None, _FIRST_ORDER + _NO_RELAXATION, _LIM,
    ),
    PublishedTissue(
        "pig subdermal fat (Sims 2010)", "skin", "μ = 0.53 kPa, Prony α = 0.39, τ = 700 s",
        ((1.06, 2.0),), 53.0, (),
        "neo-Hookean: one Ogden term, m = 2 and c = 2 μ; left elastic, since within 2 s of τ = 700 s the "
        "stress relaxes by less than 0.2 %",
        "Sims et al., Biomech. Model. Mechanobiol. 9 (2010) 703, abstract",
    ),
    PublishedTissue(
        "residuum, muscle complex (Sengeh 2016)", "muscle", "c = 5.20 kPa, m = 4.78, γ = 3.47, τ = 0.34 s",
        ((5.20, 4.78), (5.20, -4.78)), 520.0, (3.47, 0.34), _SECOND_ORDER, f"{_PAPER}, table 1",
    ),
    PublishedTissue(
        "rat tibialis anterior (Bosboom 2001)", "muscle", "c = 15.6 kPa, m = 21.4, γ = 0.549, τ = 6.01 s",
        ((15.6, 21.4),), 1560.0, (0.549, 6.01),
        _FIRST_ORDER + "; its δ = 0.549 read as γ, as in the paper",
        "Bosboom et al., J. Biomech. 34 (2001) 1365, abstract, and as quoted by Sengeh et al. 2016 [their 9]",
    ),
    PublishedTissue(
        "human thigh, softest (Affagard)", "muscle", "C10 = 1.75 kPa",
        ((7.0, 2.0),), 350.0, None, _NEO_HOOKEAN + _NO_RELAXATION, _AFFAGARD,
    ),
    PublishedTissue(
        "human thigh, stiffest (Affagard)", "muscle", "C10 = 3.75 kPa",
        ((15.0, 2.0),), 750.0, None, _NEO_HOOKEAN + _NO_RELAXATION, _AFFAGARD,
    ),
)  # fmt: skip
