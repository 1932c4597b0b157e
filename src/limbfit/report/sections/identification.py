"""The identification: parameters (table 1 of the paper) with what determines them, and how it went."""

from collections import Counter

from ...results.identification import CorrelationMatrix, SearchStage
from ..drawing.figures import draw_convergence_figure, draw_interval_figure
from ..drawing.interactive import draw_convergence_curves
from ..formats import format_fixed, format_parameter
from ..page import Block, Bullets, Cell, Section, Table, make_bullets
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, write_words

EQUAL_PERCENT = 0.01  # of the largest force: what the tolerance of an equilibrium leaves


def make_parameter_section(store: Results) -> Section:
    """Table 1, intervals and correlations."""
    known = store.uncertainty
    if known is None:
        return make_section("parameters")
    truth = store.truth.get("parameters", {})
    return make_section(
        "parameters",
        make_table("parameters", store.parameters, store=store, known=known, truth=truth),
        draw_interval_figure(store),
        make_correlation_table(known.correlation),
        describe_relaxation(store),
        describe_priors(store),
        _describe_combinations(store),
        make_prose("residuals", found=known.residuals),
    )


def make_correlation_table(correlation: CorrelationMatrix) -> Table:
    """The correlation of every pair of parameters, coloured."""
    heads = [format_parameter(name) for name in correlation.names]
    pairs = zip(heads, correlation.matrix, strict=True)
    rows = []
    for head, values in pairs:
        cells = [Cell(format_fixed(r, 2), number=True, shade=max(-1.0, min(1.0, r))) for r in values]
        rows.append(make_row(head, *cells))
    return Table("correlation", write_words("table correlation"), ("", *heads), tuple(rows))


def describe_relaxation(store: Results) -> tuple[Block | None, ...]:
    """What the records tell of relaxation, and the modulus of each tissue at several times after a step."""
    found = store.uncertainty.relaxation if store.uncertainty else None
    if found is None:
        return ()
    return make_prose("relaxation", found=found), make_table("moduli", found.moduli, store=store)


def describe_priors(store: Results) -> tuple[Block | None, ...]:
    """Each parameter's prior, how much of its variance priors cause, and its interval without them."""
    found = store.uncertainty.priors if store.uncertainty else None
    if found is None:
        return ()
    return make_prose("priors", found=found), make_table("priors", store.parameters, store=store, found=found)


def _describe_combinations(store: Results) -> tuple[Block | None, ...]:
    """What the data determine of several parameters together, best determined first."""
    sentences = list(store.uncertainty.combinations) if store.uncertainty else []
    if not sentences:
        return ()
    for name in map(".".join, store.parameters):
        sentences = [sentence.replace(name, format_parameter(name)) for sentence in sentences]
    return make_prose("combinations"), Bullets(tuple(sentences))


def make_convergence_section(store: Results) -> Section:
    """How the identification went."""
    return make_section(
        "convergence",
        make_bullets(write_words("end of a stage", stage=stage) for stage in store.stages),
        draw_convergence_figure(store),
        draw_convergence_curves(store),
        describe_search(store),
        (make_iteration_table(store, stage) for stage in store.stages if stage.iterations),
    )


def make_iteration_table(store: Results, stage: SearchStage) -> Table | None:
    """Every accepted iterate of one identification stage."""
    known = tuple(stage.parameters)
    alike = all(values == stage.parameters[known[0]] for values in stage.parameters.values())
    tissues = known[:1] if alike else known  # one material, unless the study fixes a tissue's own value
    name = f"iterations-{stage.name.replace(' ', '-')}"
    return make_table(
        name, stage.iterations, folded=True, words="iterations", stage=stage, tissues=tissues, store=store
    )


def describe_search(store: Results) -> tuple[Bullets | None, Table | None]:
    """What the record of the identification says of its doubtful simulations; nothing where none is."""
    if store.calibration is None:
        return None, None
    found = store.calibration.doubts
    rows, answer = found.search, found.answer
    texts = []
    if rows:
        kinds = Counter(row.kind for row in rows)
        used = sum(row.iterate is not None for row in rows)
        texts.append(write_words("doubts of the search", found=found, kinds=kinds, used=used))
    texts += [
        f"At the answer, site {site}: {doubt.text}." for site, doubts in answer.items() for doubt in doubts
    ]
    for site, one in store.calibration.contact.items():
        if (off := one.from_rest_percent or 0.0) > EQUAL_PERCENT:
            texts.append(write_words("doubt of the answer", site=site, off=off))
    return make_bullets(texts), make_table("doubtful-simulations", rows, folded=True)
