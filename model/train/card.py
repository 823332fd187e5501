"""A model card beside every generator: what it is, what it was trained on, how good it is, what it is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from model.train.checkpoint import sha256, write_whole
from model.train.config import TrainConfig

_NUMBERS = (("MSE", "mse", ".3g"), ("PSNR, dB", "psnr_db", ".2f"), ("IoU", "iou", ".5f"), ("CSIM", "csim", ".5f"))
_NUMBERS += (("SSIM, mean", "ssim", ".5f"), ("SSIM, least", "ssim_min", ".5f"))


def write_card(path: Path, config: TrainConfig, report: dict[str, Any], checks: tuple[str, ...] = ()) -> Path:
    """Write the card of the file at `path` as `<stem>.md`, or `<name>.md` for an export; raises OSError."""
    name = path.stem if path.suffix == ".safetensors" else path.name
    card = path.with_name(f"{name}.md")
    write_whole(card, card_text(path, config, report, checks).encode())
    return card


def card_text(path: Path, config: TrainConfig, report: dict[str, Any], checks: tuple[str, ...] = ()) -> str:
    """The card as Markdown."""
    target, tuning = config.target, config.tuning
    side_mm = target.size_px * target.px_mm
    lines = [
        f"# {path.name}",
        "",
        f"A network that draws the press of a brush, trained on exact area coverage of the stroke model "
        f"`{target.model}`{' and tuned on captured strokes' if tuning else ''}.",
        "",
        f"- Content: sha256 `{sha256(path)}`",
        f"- Image: {target.size_px} x {target.size_px} px of {target.px_mm:g} mm ({side_mm:g} mm a side), ink 1 on 0, "
        f"placement `{target.placement}`, heading 0",
        f"- Brush: R {target.radius_mm:g} mm, L {target.length_mm:g} mm, lambda {target.lam:.5g}"
        + (" (fitted to captures)" if target.fitted_brush else ""),
        f"- Network: {config.weight_count():,} weights, {config.layers.model_dump()}",
        f"- Training: {report.get('steps')} steps of {config.batch}, seed {config.seed}, {report.get('end')}; "
        f"{report.get('cpu_s')} s of CPU time since the last start; torch {report.get('torch')}",
        "",
        "| input | unit | from | to | meaning |",
        "|---|---|---|---|---|",
    ]
    for spec in config.build_target().inputs:
        lines.append(f"| `{spec.name}` | {spec.unit} | {spec.low:g} | {spec.high:g} | {spec.meaning} |")
    images = "captured strokes that were held out" if tuning else "exact images that it was not trained on"
    lines += ["", f"On {report.get('images')} {images} ({report.get('ssim_settings')}):", "", "| | |", "|---|---|"]
    for label, key, form in _NUMBERS:
        value = report.get(key)
        if isinstance(value, int | float):
            lines.append(f"| {label} | {value:{form}} |")
    lines += ["", "## Limits", ""]
    if tuning:
        lines += [
            f"- Tuned on captures of: {_plain(tuning.source)}. Other captures of that kind are not blind.",
            f"- Started from a generator with sha256 `{tuning.start_sha256}`; captures `{tuning.captures_sha256}`.",
        ]
    else:
        lines.append("- It has seen no real ink: it repeats a closed-form model, and is no better on paper than that.")
    lines.append("- Outside the ranges above it extrapolates polynomials: do not ask it there.")
    lines += [f"- {check}" for check in checks]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Words from a file, without what Markdown or HTML would read."""
    return "".join(c if c.isalnum() or c in " .,-_()/:" else "?" for c in text)
