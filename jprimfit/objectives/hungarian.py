"""The assignment of rows to columns of least total cost, on the device: shortest augmenting paths.

Each row in turn takes the cheapest path through rows that are placed already to a column that is free (Jonker and
Volgenant 1987, in the form of Crouse 2016). The search looks at all columns at once and skips rows that are masked;
Optax' version visits the columns one by one, which for a batch on a GPU means thousands of launches of tiny kernels.
r rows, c columns.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class _State(NamedTuple):
    """A partial assignment and the prices that prove it the cheapest one of its rows."""

    row_price: Float[Array, " r"]
    column_price: Float[Array, " c"]
    column_of: Int[Array, " r"]  # -1 = not placed
    row_of: Int[Array, " c"]  # -1 = free


class _Search(NamedTuple):
    """A search from one row for the free column that is cheapest to reach."""

    length: Float[Array, " c"]  # of the shortest path known to every column
    previous: Int[Array, " c"]  # the row from which that path comes
    done: Bool[Array, " c"]  # its length is final
    row: Int[Array, ""]  # where the search stands
    reached: Float[Array, ""]  # the length of the path to there
    end: Int[Array, ""]  # the free column found, -1 = none yet


def assign(cost: Float[Array, "r c"], row_mask: Bool[Array, " r"]) -> Int[Array, " r"]:
    """Column of every row of the mask, no column twice, at the least sum of costs; -1 for all other rows.

    Costs must be finite, and the columns no fewer than the rows. Among equal costs the choice is arbitrary but fixed.
    """
    num_rows, num_columns = cost.shape
    if num_rows > num_columns:
        raise ValueError(f"{num_rows} rows for {num_columns} columns: add columns of a high cost")
    start = _State(
        jnp.zeros(num_rows, cost.dtype),
        jnp.zeros(num_columns, cost.dtype),
        jnp.full(num_rows, -1, jnp.int32),
        jnp.full(num_columns, -1, jnp.int32),
    )
    return jax.lax.fori_loop(0, num_rows, lambda row, state: _place(cost, row, row_mask[row], state), start).column_of


def _place(cost: Float[Array, "r c"], row: Int[Array, ""], is_used: Bool[Array, ""], state: _State) -> _State:
    """The assignment with one more row, unless it is not used."""
    search = _Search(
        jnp.full_like(state.column_price, jnp.inf),
        jnp.full_like(state.row_of, -1),
        jnp.zeros(state.row_of.shape, bool),
        jnp.int32(row),
        jnp.zeros((), cost.dtype),
        jnp.where(is_used, -1, 0).astype(jnp.int32),
    )
    search = jax.lax.while_loop(lambda s: s.end < 0, lambda s: _advance(cost, state, s), search)
    slack = jnp.where(search.done, search.reached - search.length, 0)
    # The free column at the end has no slack, so nothing is added for its row_of of -1.
    row_price = state.row_price.at[state.row_of].add(slack).at[row].add(search.reached)

    def flip(path):
        column_of, row_of, column, _ = path
        previous = search.previous[column]
        left = column_of[previous]
        return column_of.at[previous].set(column), row_of.at[column].set(previous), left, previous == row

    path = state.column_of, state.row_of, search.end, ~is_used
    column_of, row_of, _, _ = jax.lax.while_loop(lambda path: ~path[3], flip, path)
    return _State(row_price, state.column_price - slack, column_of, row_of)


def _advance(cost: Float[Array, "r c"], state: _State, search: _Search) -> _Search:
    """Looks at all columns from the row where the search stands, and goes on to the nearest that is not done."""
    through = search.reached + cost[search.row] - state.row_price[search.row] - state.column_price
    better = ~search.done & (through < search.length)
    length = jnp.where(better, through, search.length)
    previous = jnp.where(better, search.row, search.previous)
    open_length = jnp.where(search.done, jnp.inf, length)
    reached = jnp.min(open_length)
    nearest = open_length == reached
    is_free = nearest & (state.row_of < 0)  # among equals a free column ends the search at once
    column = jnp.argmax(jnp.where(jnp.any(is_free), is_free, nearest)).astype(jnp.int32)
    row = state.row_of[column]
    return _Search(length, previous, search.done.at[column].set(True), row, reached, jnp.where(row < 0, column, -1))
