"""What is compiled for one set of recordings after another does not pile up until the process is killed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from pmdc_jax import compiled


@pytest.mark.parametrize(("used", "times"), [(600, 2), (400, 1)], ids=["full", "room"])
def test_what_was_compiled_is_forgotten_only_where_there_is_no_room_for_more(
    tmp_path, monkeypatch, used, times
):
    maps, limit = tmp_path / "maps", tmp_path / "max_map_count"
    maps.write_text("7f00-7f01 r-xp\n" * used)
    limit.write_text("1000\n")
    monkeypatch.setattr(compiled, "MAPS", maps)
    monkeypatch.setattr(compiled, "LIMIT", limit)
    traced = []

    @jax.jit
    def doubled(x):
        traced.append(x)
        return 2 * x

    doubled(jnp.ones(3))
    compiled.make_room()
    assert doubled(jnp.ones(3)).sum() == 6
    assert len(traced) == times


def test_where_a_system_does_not_say_nothing_is_done(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "MAPS", tmp_path / "none")
    monkeypatch.setattr(jax, "clear_caches", lambda: pytest.fail("cleared"))
    compiled.make_room()
