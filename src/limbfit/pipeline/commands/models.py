"""Other models of the same limb and records: what an answer owes to the choice of its model.

Each model is the study with one thing changed: its relaxation, its hyperelastic law, fibres, the thickness
of the outermost layer, or friction. It is an ordinary study in ``results/models/<name>``, which is calibrated
and predicts every record like the study itself. Models are weighed by how probable they make the fitted
records (the Laplace evidence of their calibrations), and a prediction is the mixture of theirs.
"""

import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from ...arrays import Array
from ...errors import InputError
from ...identify.fit.prediction import NORMAL_95
from ...identify.uncertainty.likelihood import compute_mixture_interval, weigh_models
from ...laws import FIBRED, FUNG, LAWS, OGDEN, POWER
from ...results import uncertainty as stored
from ...results.base import read_curves
from ...results.identification import RecordPrediction
from ...results.socket import LoadedRegion, SocketResult
from ...study import Study, load_study
from ..engine.context import Listener, ignore_progress
from ..engine.store import Store, find_hand_labels, lock, write_curves, write_result
from .planning import fit_socket
from .run import compute_keys, run_study

FOLDER = "models"
OWN_MODEL = "the study's own"
TWO_TERMS = "ogden-prony2"
_LAYER_MM, _MIN_LAYER_MM, _FRICTION = 1.0, 0.5, 0.4
MIN_SOCKET_WEIGHT = 0.01  # of a model whose socket is simulated

Document = tomlkit.TOMLDocument


@dataclass(frozen=True)
class ModelChange:
    """A model that may stand for the study's: what is changed, in ``words``, and how.

    ``change`` alters the study's file; it raises `InputError` if the study cannot be changed so.
    """

    words: str
    change: Callable[[Study, Document], None]


def _set_law(name: str, fibred: bool = False) -> Callable[[Study, Document], None]:
    """Give all tissues another law; starts, bounds and priors of parameters that it lacks are left out."""

    def change(study: Study, document: Document) -> None:
        if study.material.law != OGDEN:
            what = f'the study\'s law is "{study.material.law}"'
            raise InputError(what, remedy=f'only "{OGDEN}" has this alternative')
        material = document.setdefault("material", tomlkit.table())
        material["law"] = name
        keys = set(LAWS[name].keys)
        for table in (material, *material.get("tissues", {}).values()):
            for which in ("start", "lower", "upper"):
                for key in [key for key in table.get(which, {}) if key not in keys]:
                    del table[which][key]
        if fibred:
            material["fibres"] = {study.tissues[-1]: "axis"}
        calibration = document.get("calibration", {})
        if name in (POWER, FUNG):  # no people are described by these
            calibration.pop("priors", None)
        for key in ("prior", "fixed", "tied"):  # such as ``skin.tau_s``, or ties of several
            stated = calibration.get(key)
            lacking = [one for one in stated or () if not _is_known(one, keys)]
            for one in lacking:
                stated.remove(one) if isinstance(stated, list) else stated.pop(one)

    return change


def _is_known(stated: str | Sequence[str], keys: Collection[str]) -> bool:
    names = [stated] if isinstance(stated, str) else stated
    return all(name.rpartition(".")[2] in keys for name in names)


def _change_layer(change_mm: float) -> Callable[[Study, Document], None]:
    """Make the outermost layer of stated thickness so much thicker."""

    def change(study: Study, document: Document) -> None:
        layers = study.geometry.model_layers
        number = next((i for i, one in enumerate(layers) if one.thickness_mm is not None), None)
        if number is None:
            raise InputError("no layer has a stated thickness", remedy="the label map decides it")
        stated = layers[number].thickness_mm or 0.0
        if stated + change_mm < _MIN_LAYER_MM:
            raise InputError(f"the layer is only {stated:g} mm thick", remedy="leave this model out")
        geometry: Any = document.setdefault("geometry", tomlkit.table())
        if "layers" in geometry:
            geometry["layers"][number]["thickness_mm"] = stated + change_mm
        else:
            geometry["skin_layer_mm"] = stated + change_mm

    return change


def _set_friction(study: Study, document: Document) -> None:
    """Give every indenter a coefficient of friction; frictionless ones slide less, sticky ones more."""
    if study.indenter.friction == _FRICTION:
        raise InputError(f"friction is {_FRICTION:g} already", remedy="leave this model out")
    document.setdefault("indenter", tomlkit.table())["friction"] = _FRICTION
    for table in document.get("indenters", {}).values():
        table["friction"] = _FRICTION


MODELS: dict[str, ModelChange] = {
    "two-terms": ModelChange("two relaxation terms", _set_law(TWO_TERMS)),
    "power": ModelChange("relaxation as a power of time", _set_law(POWER)),
    "fung": ModelChange("Fung's exponential law", _set_law(FUNG)),
    "fibres": ModelChange("fibres along the limb", _set_law(FIBRED, fibred=True)),
    "thinner": ModelChange(f"outer layer {_LAYER_MM:g} mm thinner", _change_layer(-_LAYER_MM)),
    "thicker": ModelChange(f"outer layer {_LAYER_MM:g} mm thicker", _change_layer(_LAYER_MM)),
    "friction": ModelChange(f"friction of {_FRICTION:g} under the indenter", _set_friction),
}


def select_models(names: Sequence[str]) -> tuple[str, ...]:
    """The models of these names, each once; "all" stands for every one.

    Raises `InputError` for a name that no model has.
    """
    unknown = [name for name in names if name not in (*MODELS, "all")]
    if unknown or not names:
        what = f"no model is named {unknown[0]!r}" if unknown else "no model is named"
        raise InputError(what, place="--models", remedy="use all, or some of " + ", ".join(MODELS))
    return tuple(dict.fromkeys(MODELS if "all" in names else names))


def derive_study(study: Study, name: str) -> Study:
    """Write the study of a model, with the same inputs, into its folder.

    Raises `InputError` if the study cannot be changed so.
    """
    folder = study.results / FOLDER / name
    document = tomlkit.parse(study.file.read_text(encoding="utf-8-sig"))
    try:
        MODELS[name].change(study, document)
        folder.mkdir(parents=True, exist_ok=True)
        _link_inputs(study, folder, document)
        (folder / "study.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
        return load_study(folder)
    except InputError as error:
        raise InputError(f"model {name}: {error.what}", place=error.place, remedy=error.remedy) from None


def _share_stages(study: Study, derived: Study) -> None:
    """Give a model what is stored of its study and would come out the same."""
    by_hand, copy = (one.results / "by-hand" for one in (study, derived))
    shutil.rmtree(copy, ignore_errors=True)  # the labels may have been corrected again, or taken back
    if by_hand.is_dir():
        shutil.copytree(by_hand, copy)
    done, own = Store(study.results), Store(derived.results)
    for stage, key in compute_keys(derived).items():
        if done.state(stage, key).state != "done" or own.state(stage, key).state == "done":
            continue
        if own[stage].is_dir():
            shutil.rmtree(own[stage])
        shutil.copytree(done[stage], own[stage], copy_function=_link_or_copy)


def _link_inputs(study: Study, folder: Path, document: Document) -> None:
    """Make every input of the study appear at the same relative path below ``folder``."""
    root = study.folder.resolve()
    for path in sorted({*study.inputs.values(), *filter(None, [find_hand_labels(study)])}):
        if path.is_absolute() or ".." in path.parts:
            if not path.is_absolute():
                _replace_path(document, path, os.path.relpath(root / path, folder.resolve()))
            continue
        top = Path(path.parts[0])
        if top.name == study.results.name:
            continue
        place = folder / top
        if not place.exists():
            try:
                place.symlink_to(os.path.relpath(root / top, folder.resolve()))
            except OSError:  # no right to make links
                (shutil.copytree if (root / top).is_dir() else shutil.copyfile)(root / top, place)


def _replace_path(table: Any, old: Path, new: str) -> None:
    for key, value in table.items() if isinstance(table, Mapping) else enumerate(table):
        if isinstance(value, Mapping | list):
            _replace_path(value, old, new)
        elif isinstance(value, str) and Path(value) == old:
            table[key] = new


def _link_or_copy(source: str, target: str) -> None:
    """A second name of a file that is never written in place, or a copy where there are no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def compare_models(
    study: Study, models: Sequence[str], *, listener: Listener = ignore_progress
) -> dict[str, Any]:
    """Calibrate other models of the study on the same records, weigh them, and mix their predictions.

    A model takes about as long as the study's own calibration; what is stored already is not done again.
    ``models``: names in `MODELS`, or "all". Returns what ``results/models/models.json`` holds, and
    ``folder``. Raises `InputError` for a model that there is not, or that the study cannot have.
    """
    derived, left_out = {}, {}
    for name in select_models(models):
        try:
            derived[name] = derive_study(study, name)
        except InputError as error:
            if "all" not in models:
                raise
            left_out[name] = str(error)
    run_study(study, until="predict", listener=listener)
    for number, name in enumerate(derived, 1):
        words = f"model {number} of {len(derived)}, {MODELS[name].words}"
        _share_stages(study, derived[name])
        run_study(derived[name], until="predict", listener=_name_model(listener, words))
    with lock(study.results):
        content = _mix_predictions(study, derived, left_out)
        write_result(study.results / stored.ModelsResult.FILE, content)
    return content.to_plain() | {"folder": str(study.results / FOLDER)}


def _name_model(listener: Listener, words: str) -> Listener:
    return lambda event: listener(replace(event, text=f"{words}: {event.text}"))


def _mix_predictions(
    study: Study, derived: Mapping[str, Study], left_out: Mapping[str, str]
) -> stored.ModelsResult:
    """Weights of the models, and for each record the interval of the study's own and of all."""
    stores = {OWN_MODEL: Store(study.results), **{name: Store(one.results) for name, one in derived.items()}}
    calibrations = [store.results.calibration for store in stores.values()]
    evidence = [one.uncertainty.minus_2_log_evidence for one in calibrations]
    weights = weigh_models(evidence)
    predicted = [store.results.predict for store in stores.values()]
    models = [
        stored.CalibratedModel(
            model=name,
            words=MODELS[name].words if name in MODELS else "as the study states it",
            weight=weight,
            evidence=evidence[0] - value,
            error_fitted_percent=found.mean_error_fitted_percent,
            error_heldout_percent=found.mean_error_heldout_percent,
            parameters=calibration.parameters,
        )
        for name, weight, value, found, calibration in zip(
            stores, weights, evidence, predicted, calibrations, strict=True
        )
    ]
    records = [_mix_record(stores, weights, row, study.results / FOLDER) for row in predicted[0].sites]
    mixed = [record for record in records if record is not None]
    return stored.ModelsResult(models=models, records=mixed, left_out=left_out)


def _mix_record(
    stores: Mapping[str, Store], weights: Array, row: RecordPrediction, folder: Path
) -> stored.MixedPrediction | None:
    """The largest value of a record and its intervals, N or mm; None if a model does not predict it."""
    curves = [read_curves(store["predict"] / f"{row.record}.csv") for store in stores.values()]
    ends = [[one[key] for key in one if "_low_" in key or "_high_" in key] for one in curves]
    if not all(ends):
        return None
    low, high = np.array(ends).swapaxes(0, 1)
    means, sds = (low + high) / 2, (high - low) / (2 * NORMAL_95)
    mixed = compute_mixture_interval(means, sds, weights)
    between = np.sqrt(weights @ (means - weights @ means) ** 2)
    head = next(key for key in curves[0] if "_measured_" in key)
    name, unit = head.split("_measured_")
    measured = curves[0][head]
    by_model = {f"{name}_{'own' if key == OWN_MODEL else key}_{unit}": one for key, one in zip(stores, means)}
    band = {f"{name}_low_{unit}": mixed[0], f"{name}_high_{unit}": mixed[1]}
    times = {"time_s": curves[0]["time_s"]}
    write_curves(folder / f"{row.record}.csv", **times, **{head: measured}, **band, **by_model)
    peak = int(np.argmax(np.abs(measured)))
    return stored.MixedPrediction(
        site=row.site,
        record=row.record,
        fitted=row.fitted,
        unit=unit,
        peak=measured[peak],
        own_interval_95=(low[0][peak], high[0][peak]),
        interval_95=(mixed[0][peak], mixed[1][peak]),
        sd_between_models=between[peak],
        inside_percent=100 * float(np.mean((measured >= mixed[0]) & (measured <= mixed[1]))),
    )


def fit_socket_of_models(study: Study, *, listener: Listener = ignore_progress) -> dict[str, Any]:
    """Put the socket on the limb with every model that counts, and mix the mean pressures of its regions.

    The models are those that `compare_models` has weighed last, of at least `MIN_SOCKET_WEIGHT`. Returns what
    ``results/models/socket.json`` holds, and ``folder``. Raises `InputError` if no models were compared, or
    the study's own socket cannot be simulated.
    """
    compared = stored.ModelsResult.find(study.results)
    if compared is None:
        what, remedy = "no other models were compared", "limbfit uncertainty --models all"
        raise InputError(what, file=study.file, remedy=remedy)
    names = [one.model for one in compared.models if one.model != OWN_MODEL]
    compare_models(study, names, listener=listener)  # anew where the study has changed
    compared = stored.ModelsResult.read(study.results)
    chosen = [one for one in compared.models if one.weight >= MIN_SOCKET_WEIGHT]
    sockets = []
    for one in chosen:
        of_model = study if one.model == OWN_MODEL else load_study(study.results / FOLDER / one.model)
        fit_socket(of_model, listener=_name_model(listener, f"socket, {one.words}"))
        sockets.append(SocketResult.read(of_model.results))
    weights = np.array([one.weight for one in chosen])
    content = stored.SocketOfModels(
        models=[stored.ModelWeight(model=one.model, words=one.words, weight=one.weight) for one in chosen],
        loads=_mix_pressures(sockets, weights / weights.sum()),
    )
    with lock(study.results):
        write_result(study.results / stored.SocketOfModels.FILE, content)
    return content.to_plain() | {"folder": str(study.results / FOLDER)}


def _mix_pressures(sockets: Sequence[SocketResult], weights: Array) -> list[stored.MixedLoad]:
    """For donning and each load, the mean pressure of each region by every model, and of all."""
    mixed = []
    for name in sockets[0].states:
        by_region = zip(*(socket.states[name].regions for socket in sockets), strict=True)  # of every model
        regions = [_mix_region(same, weights) for same in by_region]
        mixed.append(stored.MixedLoad(name=name, regions=regions))
    return mixed


def _mix_region(same: Sequence[LoadedRegion], weights: Array) -> stored.MixedPressure:
    means = np.array([region.mean_kPa for region in same])
    ends = np.array([region.interval_kPa or 2 * (region.mean_kPa,) for region in same])
    sds = (ends[:, 1] - ends[:, 0]) / (2 * NORMAL_95)
    low, high = compute_mixture_interval(ends.mean(axis=1)[:, None], sds[:, None], weights)
    return stored.MixedPressure(
        region=same[0].region, mean_kPa=means.tolist(), interval_kPa=(max(float(low[0]), 0.0), high[0])
    )
