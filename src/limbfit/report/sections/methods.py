"""The method in words for a paper's supplement, made of what is stored: settings, meshes, runs, versions.

Nothing here comes from an image's header, and inputs are named by their keys in the study file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ...laws import OGDEN
from ...shapes import SHAPES
from ..formats import fixed, friction, held, number, symbol, unit_of
from ..page import Prose, Section
from ..site_tables import mean_and_deviation, noise_and_misfit
from ..store import Json, Results
from ..tables import NOTHING, flatten
from .priors import constraints

Part = tuple[str, str]  # a heading and its paragraph


def method_section(store: Results) -> Section:
    """The parts as paragraphs, each after its heading."""
    return Section("method", "Methods", tuple(Prose(f"{head}. {text}") for head, text in method_parts(store)))


def method_markdown(store: Results) -> str:
    """The same as Markdown, with every setting as a table at its end."""
    name = str((store.run.get("study") or {}).get("name") or "Unnamed study")
    lines = [f"# Methods: {name}", ""]
    for head, text in method_parts(store):
        lines += [f"## {head}", "", text, ""]
    settings = flatten(store.run.get("settings") or {})
    if settings:
        lines += ["## Every setting", "", "| key | value |", "|---|---|"]
        lines += [f"| {_cell(key)} | {_cell(value)} |" for key, value in settings.items()]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")


def method_parts(store: Results) -> tuple[Part, ...]:
    """Heading and paragraph of every part of which something is stored."""
    parts = (
        ("Geometry", _geometry(store)),
        ("Indentations", _indentations(store)),
        ("Meshes", _meshes(store)),
        ("Constitutive law", _law(store)),
        ("Boundary conditions and contact", _contact(store)),
        ("Solution", _solution(store)),
        ("Identification", _identification(store)),
        ("Uncertainty", _uncertainty(store)),
        ("Prediction", _prediction(store)),
        ("Further analyses", _experiments(store)),
        ("Software", _software(store)),
    )
    return tuple((head, text) for head, text in parts if text)


def _settings(store: Results, table: str) -> Json:
    return (store.run.get("settings") or {}).get(table) or {}


def _said(sentences: Iterable[str]) -> str:
    return " ".join(sentence for sentence in sentences if sentence)


def _geometry(store: Results) -> str:
    geometry = _settings(store, "geometry")
    source = store.segment.get("method")
    start = (
        f"The image was segmented ({source})."
        if source
        else "Closed surfaces of skin and bones were given."
        if _settings(store, "surfaces")
        else ""
    )
    repairs = len(store.segment.get("repairs") or ())
    edge = geometry.get("surface_edge_mm")
    inner = ", ".join(region["name"] for region in geometry.get("regions") or ())
    return _said(
        (
            start,
            f"{repairs} repairs were made to the label map." if repairs else "",
            f"Smooth closed surfaces have edges of about {edge} mm." if edge else "",
            _layers(geometry),
            f"Regions inside the core, to which the mesh conforms: {inner}." if inner else "",
            "Bones are voids. Where bone lies shallower than the layer, the rule is "
            f"“{geometry['bone_policy']}”, with {geometry.get('bone_clearance_mm')} mm between."
            if geometry.get("bone_policy")
            else "",
            "Coordinates are those of the patient (LPS), in millimetres." if store.sites else "",
        )
    )


def _layers(geometry: Json) -> str:
    """The layers of tissue in a sentence."""
    layers = geometry.get("layers")
    if not layers:
        thickness = geometry.get("skin_layer_mm")
        return f"The skin–adipose layer is {thickness} mm thick." if thickness else ""
    words = []
    for layer in layers:
        stated, least = layer.get("thickness_mm"), layer.get("min_thickness_mm")
        thick = f"{stated} mm" if stated else f"as thick as the segmented fat, at least {least} mm"
        words.append(f"{layer['name']} ({thick})")
    return f"Layers over the {geometry.get('core')}, outermost first: {', '.join(words)}."


def _indentations(store: Results) -> str:
    if not store.traces:
        return ""
    facts = tuple(store.traces.values())
    sites = len({one.get("site", name) for name, one in store.traces.items()})
    words = "a record" if sites == len(facts) else f"{len(facts)} records"
    marked = sum(1 for site in store.sites if site.get("marker"))
    where = f" {marked} of their places come from skin markers in the image." if marked else ""
    noise = [fact["noise_N"] for fact in facts if fact.get("noise_N") is not None]
    return (
        f"{sites} sites have {words} of time, displacement and force; {len(store.fitted)} were fitted "
        f"({', '.join(store.fitted)}).{where} The indenter's axis is the mean inward normal of the skin "
        "under it unless the study states one. Touch-down is where the force of each record leaves its "
        f"baseline as a power of the depth in a tissue with memory{_touch_downs(facts)}; from there on "
        "displacement was made piecewise linear and force smoothed, every phase (loading, hold, unloading) "
        "by itself so that the peak is kept; where parameters are searched and judged, simulated force is "
        "smoothed in the same way. "
        f"Depths are {_range(facts, 'depth_mm', 2)} mm, largest forces {_range(facts, 'peak_force_N', 2)} N, "
        f"loading speeds {_range(facts, 'speed_load_mm_s', 2)} mm/s"
        + (f", noise of the force {fixed(min(noise), 3)} to {fixed(max(noise), 3)} N." if noise else ".")
    )


def _touch_downs(facts: Sequence[Json]) -> str:
    known = [one for one in facts if one.get("touch_down_uncertainty_mm") is not None]
    ends = _range(known, "touch_down_uncertainty_mm", 3)
    return f" (known to {ends} mm, one standard deviation)" if known else ""


def _range(facts: Iterable[Json], key: str, digits: int) -> str:
    values = [fact[key] for fact in facts if isinstance(fact.get(key), int | float)]
    return f"{fixed(min(values), digits)} to {fixed(max(values), digits)}" if values else NOTHING


def _meshes(store: Results) -> str:
    table = _settings(store, "mesh")
    if not store.mesh:
        return ""
    facts = tuple(store.mesh.values())
    element = table.get("element") or facts[0].get("element")
    knob = f" (mesh.accuracy = “{table['accuracy']}”)" if table.get("accuracy") else ""
    edges = (
        f" by {table.get('engine')}: edges of {table['edge_near_mm']} mm within "
        f"{table.get('near_radius_mm')} mm of the site, growing at {table.get('growth')} per mm "
        f"to {table.get('edge_far_mm')} mm{knob}"
        if "edge_near_mm" in table
        else ""
    )
    size = (
        f"They have {_range(facts, 'nodes', 0)} nodes and {_range(facts, 'cells', 0)} elements, with a "
        f"smallest dihedral angle of {_range(facts, 'min_dihedral_deg', 1)} degrees."
    )
    return _said((f"Each site has a mesh of its own of {_element(element)}{edges}.", size, _search(store)))


def _search(store: Results) -> str:
    """On what parameters were searched, where that was not the meshes themselves."""
    coarse = _settings(store, "mesh").get("coarse")
    radius = _settings(store, "calibration").get("search_radius_mm")
    of = f"coarser meshes ({_pairs(coarse)})" if coarse else "these meshes" if radius else ""
    within = f"the part of {of} within {radius} mm of the site" if radius else of
    return f"Parameters were searched on {within}, corrected by the whole meshes." if of else ""


def _element(name: object) -> str:
    words = {
        "tet4": "linear tetrahedra (tet4)",
        "tet10": "quadratic tetrahedra (tet10)",
        "tet10p0": "quadratic tetrahedra with constant pressure (tet10p0)",
    }
    return words.get(str(name), str(name))


def _pairs(table: Json) -> str:
    return ", ".join(f"{key} = {value}" for key, value in table.items() if value not in (None, [], ""))


def _law(store: Results) -> str:
    kappa = number(_settings(store, "material").get("kappa_ratio"))
    if store.law.name != OGDEN:
        bulk = f"The bulk modulus is the long-term shear modulus times {kappa}."
        return f"Each tissue has the law “{store.law.words}”: {store.law.energy}. {bulk}"
    return (
        "As in Sengeh, Moerman, Petron and Herr (2016, J. Mech. Behav. Biomed. Mater. 59, 379), each "
        f"tissue has {store.law.energy}; γ has no unit. The bulk modulus κ is c times {kappa}."
    )


def _contact(store: Results) -> str:
    indenter, penalty = _settings(store, "indenter"), _settings(store, "solver").get("penalty_per_mm")
    if not indenter:
        return ""
    stiff = (
        f"a stiffness of {penalty} per mm times the mean instantaneous shear modulus"
        if penalty
        else "a stiffness with which a reference tissue lets it sink in by 1 % of the depth at most"
        f"{_penalties(store)}"
    )
    deepest = [row["penetration_mm"] for row in store.predicted if row.get("penetration_mm") is not None]
    others = "; ".join(
        f"{name}, a {SHAPES[one['shape']].said(one)}, {friction(one.get('friction'))}"
        for name, one in _settings(store, "indenters").items()
    )
    return _said(
        (
            "Nodes on bones and on the proximal cut are fixed. A rigid "
            f"{SHAPES[indenter['shape']].said(indenter)} starts where it just touches the skin and follows "
            f"the recorded displacement along its axis; contact is {friction(indenter.get('friction'))}, by "
            f"a penalty at the skin's quadrature points with {stiff}.",
            held(_settings(store, "clamps"), _settings(store, "material")),
            f"Some records are of other indenters: {others}." if others else "",
            f"The largest penetration was {fixed(max(deepest), 3)} mm." if deepest else "",
        )
    )


def _penalties(store: Results) -> str:
    """The stiffnesses of contact that the fitted sites were given."""
    sites = (store.calibration.get("contact") or {}).values()
    values = [one["penalty_per_mm"] for one in sites if one.get("penalty_per_mm") is not None]
    ends = f"{number(min(values))} to {number(max(values))}" if values else ""
    return f" ({ends} per mm times the mean instantaneous shear modulus)" if values else ""


def _solution(store: Results) -> str:
    solver = _settings(store, "solver")
    if not solver:
        return ""
    name = store.calibration.get("linear_solver")
    return _said(
        (
            f"Quasi-static equilibrium was solved in {solver.get('load_steps')} steps of loading and "
            f"{solver.get('unload_steps')} of unloading, cut where Newton's method does not converge",
            f"(residual below {solver['tolerance']:g} of the reactions; at most {solver['max_cuts']} "
            "cuts in a row)."
            if "tolerance" in solver
            else ".",
            f"Linear systems were solved by {name}." if name else "",
            "Derivatives of the force with respect to every parameter come from the tangent at equilibrium.",
        )
    ).replace(" .", ".")


def _identification(store: Results) -> str:
    table, found = _settings(store, "calibration"), store.calibration
    if not store.stages:
        return ""
    first = store.stages[0]
    runs, exact = found.get("forward_runs"), found.get("forward_runs_with_sensitivities")
    return _said(
        (
            _objective(str(found.get("objective"))),
            f"Stages: {', then '.join(str(stage['name']) for stage in store.stages)}.",
            f"Start: {_values(first.get('start') or {})}.",
            f"Bounds: {_bounds(found.get('bounds') or {})}.",
            _stopping(table),
            constraints(table),
            f"{table['starts']} starts were tried, all but the first at random (seed {table.get('seed')})."
            if (table.get("starts") or 1) > 1
            else "",
            *(
                f"{str(stage['name']).capitalize()}: {'' if stage.get('converged') else 'not '}converged "
                "after "
                f"{stage.get('evaluations')} evaluations ({stage.get('reason')})."
                for stage in store.stages
            ),
            f"In all {runs} simulations were made, {exact} of them with derivatives."
            if runs is not None and exact is not None
            else "",
        )
    )


def _objective(name: str) -> str:
    what = (
        "equation 8 of that paper, a vector with the mean squared force difference of each site"
        if name == "paper"
        else "the force differences at all times of comparison, each over its site's largest force and the "
        "root of their number"
    )
    return (
        f"Parameters minimise {what}, by bounded least squares: a trust region in the logarithms of the "
        "parameters with exact Jacobian."
    )


def _stopping(table: Json) -> str:
    if not table:
        return ""
    if table.get("stopping") == "paper":
        return "A stage ends where no parameter or no entry of the objective changed by more than 0.01."
    return (
        f"A stage ends at a relative change of parameters below {table.get('relative_tolerance')}, where "
        "four "
        f"steps gain less than that each, or after {table.get('max_iterations')} accepted steps."
    )


def _values(tissues: Json) -> str:
    """Parameters in words; once for all tissues where they are alike."""
    texts = {
        tissue: ", ".join(f"{symbol(n)} = {number(values.get(n))}{_unit(n)}" for n in values)
        for tissue, values in tissues.items()
    }
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return "; ".join(f"{tissue} {text}" for tissue, text in texts.items()) or NOTHING


def _bounds(bounds: Json) -> str:
    lower, upper = bounds.get("lower") or {}, bounds.get("upper") or {}
    texts = {
        tissue: ", ".join(
            f"{symbol(n)} {number(values.get(n))} to {number(upper.get(tissue, {}).get(n))}{_unit(n)}"
            for n in values
        )
        for tissue, values in lower.items()
    }
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return "; ".join(f"{tissue} {text}" for tissue, text in texts.items()) or NOTHING


def _unit(name: str) -> str:
    return f" {unit_of(name)}" if unit_of(name) != NOTHING else ""


def _of_sites(sites: Json) -> str:
    """What a site's records share of the residuals' covariance, in words; nothing where it is not known."""
    words = ""
    for key, what in (("mesh_share", "the error of the meshes"), ("site_share", "that of a site as a whole")):
        if shares := [100 * one[key] for one in sites.values() if one.get(key) is not None]:
            words += f", and for {what}: {fixed(min(shares), 1)} to {fixed(max(shares), 1)} %"
    return words and f"{words} of the largest force"


def _uncertainty(store: Results) -> str:
    residuals = (store.calibration.get("uncertainty") or {}).get("residuals") or {}
    if not residuals:
        return ""
    sites = residuals.get("sites") or {}
    return (
        "Residuals at the fitted sites are taken for noise of the records and a smooth misfit of the model, "
        "correlated along the record (standard deviations, site by site: "
        f"{noise_and_misfit(sites)}){_of_sites(sites)}. 95 % intervals follow from their covariance and the "
        "exact derivatives, in the logarithms of the parameters."
    )


def _prediction(store: Results) -> str:
    if not store.predict:
        return ""
    held = {row["site"] for row in store.predicted if not row.get("fitted")}
    others = f" and {mean_and_deviation(store, 'heldout')} % at {len(held)} held-out sites" if held else ""
    return (
        "The error of a site is the mean absolute force difference over the trace over the largest "
        "measured force. "
        f"With the identified parameters it is {mean_and_deviation(store, 'fitted')} % at the fitted "
        f"sites{others} "
        "(mean ± standard deviation over sites)."
    )


def _experiments(store: Results) -> str:
    rows = store.run.get("experiments") or {}
    done = []
    for name in store.experiments:
        if name in rows:
            # What is nested (the parameters of a design) stands in the experiment's own record.
            plain = {k: v for k, v in (rows[name].get("options") or {}).items() if not isinstance(v, dict)}
            done.append(name + (f" ({_pairs(plain)})" if plain else ""))
    return f"Done beside the identification, with their options: {', '.join(done)}." if done else ""


def _software(store: Results) -> str:
    versions = store.run.get("versions") or {}
    if not store.run.get("limbfit"):
        return ""
    machine = store.run.get("machine") or {}
    libraries = ", ".join(f"{name} {version}" for name, version in versions.items())
    seconds = [stage.get("seconds") or 0.0 for stage in (store.run.get("stages") or {}).values()]
    return (
        f"limbfit {store.run['limbfit']} with {libraries}; Python {machine.get('python')} on "
        f"{machine.get('system')}, {machine.get('cores')} cores. All stages took "
        f"{fixed(sum(seconds) / 60, 1)} min. "
        "The SHA-256 of every input is stored in run.json."
    )
