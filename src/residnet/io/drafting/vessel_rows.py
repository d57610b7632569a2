"""Rows or columns of one vessel in tables of several vessels."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.names import truncate
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.geodetic_columns import MAX_COORDINATES
from residnet.io.drafting.motion_columns import MOTION_AND_WIND_CHANNELS
from residnet.io.drafting.questions import CHANNELS_KEY, READER_KEY, DraftNotes
from residnet.io.drafting.table_preview import TablePreview
from residnet.io.header_vocabulary import (
    VESSEL_COLUMN_NAMES,
    match_state_channel,
    normalize_name,
    parse_name,
)
from residnet.io.readers.quantities import SPEED_CHANNELS
from residnet.preprocessing.channel_values import is_ais_sentinel

if TYPE_CHECKING:
    import pandas as pd


def select_vessel_rows(
    previews: list[TablePreview], draft_notes: DraftNotes
) -> tuple[list[TablePreview], dict[str, Any]]:
    """Select the rows of one vessel of tables with a column that identifies vessels, as in AIS.

    Args:
        previews: first rows of the tables.
        draft_notes: receives the question for the vessel and notes.

    Returns:
        The previews with the rows of the vessel, without codes of missing values, and the key
        `select` of the reader; empty if no column identifies vessels.
    """
    import pandas as pd

    columns = {normalize_name(name): name for name in previews[0].column_names}
    column = next((columns[name] for name in VESSEL_COLUMN_NAMES if name in columns), None)
    if column is None or column in previews[0].empty_columns:
        return previews, {}

    def identities(preview: TablePreview) -> pd.Series:
        numbers = preview.numeric_columns.get(column)
        cells = preview.text_columns.get(column) if numbers is None else pd.Series(numbers)
        if cells is None:
            return pd.Series(dtype="string")
        return cells.astype("string").str.strip().str.removesuffix(".0")

    cells_of_tables = [identities(preview) for preview in previews]
    counts = pd.concat(cells_of_tables).value_counts()
    vessels = [str(vessel) for vessel in counts.index]
    if not vessels:
        return previews, {}
    key = (*READER_KEY, "select")
    vessel = vessels[0]
    if len(vessels) > 1:
        names = truncate(", ".join(vessels), 80)
        reason = (
            f"'{column}' has {len(vessels)} vessels ({names}), and one config reads one of them:"
            f" {vessel}"
        )
        text = f"vessel of column '{column}' to read"
        vessel = draft_notes.ask_question(key, text, vessel, reason, tuple(vessels[:20]))
    selected = []
    for preview, cells in zip(previews, cells_of_tables, strict=True):
        rows = np.flatnonzero((cells == vessel).to_numpy(dtype=bool, na_value=False))
        numeric = {name: values[rows] for name, values in preview.numeric_columns.items()}
        texts = {name: cell.iloc[rows] for name, cell in preview.text_columns.items()}
        for name, values in numeric.items():
            channel = match_state_channel(parse_name(name)) or ""
            numeric[name] = np.where(is_ais_sentinel(channel, "deg", values), np.nan, values)
        if rows.size:
            selected.append(
                dataclasses.replace(preview, numeric_columns=numeric, text_columns=texts)
            )
    value: Any = int(vessel) if re.fullmatch(r"\d{1,15}", vessel) else vessel
    return selected, {previews[0].original_name(column): value}


def drop_ais_turn_rate(
    columns: Sequence[str], preview: TablePreview, draft_notes: DraftNotes
) -> list[str]:
    """Return columns without a yaw rate that is coded as in AIS: integers from -128 to 127."""
    others = []
    for column in columns:
        values = preview.numeric_columns.get(column, np.zeros(0))
        values = values[np.isfinite(values)]
        is_coded = (values == np.round(values)) & (values >= -128.0) & (values <= 127.0)
        if normalize_name(column) not in _AIS_TURN_RATES or not is_coded.all():
            others.append(column)
            continue
        draft_notes.add_note(
            CHANNELS_KEY,
            f"'{column}' is coded as in AIS, 4.733 sqrt(deg/min) and -128 for unknown; it is left"
            " out, r follows from the heading",
        )
    return others


_AIS_TURN_RATES = ("rot", "rate of turn", "rateofturn")
"""Normalised names of the yaw rate in AIS."""


def match_columns_of_one_vessel(
    columns: Sequence[str],
    draft_notes: DraftNotes,
    *,
    numeric_columns: Mapping[str, np.ndarray],
    has_heading: bool,
) -> dict[str, str]:
    """Match columns to channels, using one vessel of tables with several.

    The columns of several vessels or sensors have the same suffixes behind different prefixes, as
    in `boat1_x` and `boat2_x`, including a position and an input. Prefixes of commands and constant
    positions are excluded.

    Args:
        columns: names of the columns.
        draft_notes: receives guesses and notes.
        numeric_columns: column -> values.
        has_heading: whether another source may have the heading.

    Returns:
        Channel -> column.
    """
    columns_by_prefix: dict[str, dict[str, str]] = {}
    for column in columns:
        prefix, _, suffix = re.sub(r"[\W_]+", "\0", column, count=1).partition("\0")
        columns_by_prefix.setdefault(prefix, {})[suffix] = column
    for suffixes in columns_by_prefix.values():
        same_suffix_groups = {
            prefix: prefix_columns
            for prefix, prefix_columns in columns_by_prefix.items()
            if prefix_columns.keys() == suffixes.keys()
        }
        if len(same_suffix_groups) < 2 or any(
            parse_name(prefix).has_all("command") for prefix in same_suffix_groups
        ):
            continue
        channels = match_channels([*suffixes], DraftNotes())
        position_pair = next(
            (pair for pair in (("x", "y"), (*MAX_COORDINATES,)) if {*pair} <= channels.keys()), ()
        )
        if not position_pair or not channels.keys() - {
            *MOTION_AND_WIND_CHANNELS,
            *MAX_COORDINATES,
            *SPEED_CHANNELS,
        }:
            continue
        for prefix, prefix_columns in same_suffix_groups.items():
            if any(
                np.nanstd(numeric_columns[prefix_columns[channels[name]]]) > 0.0
                for name in position_pair
            ):
                text = (
                    f"the columns of {', '.join(same_suffix_groups)} have a position each; of these"
                    f" vessels or sensors {prefix} is read; write the others to separate tables"
                )
                draft_notes.add_guess(CHANNELS_KEY, text)
                matched = match_channels([*prefix_columns], draft_notes)
                return {channel: prefix_columns[suffix] for channel, suffix in matched.items()}
    return match_channels(columns, draft_notes, has_heading=has_heading)
