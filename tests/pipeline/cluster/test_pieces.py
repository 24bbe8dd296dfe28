from __future__ import annotations

from pnpdepth_cli.pipeline.cluster.pieces import Piece, Pieces, piece_size


def handed_out(pieces: Pieces, wanted: int) -> list[list[int]]:
    items = []
    while (piece := pieces.take(wanted)) is not None:
        items.append(list(piece.items))
    return items


def test_every_item_is_handed_out_once_in_order() -> None:
    pieces = Pieces(range(7), retries=2)
    assert len(pieces) == 7
    assert handed_out(pieces, 3) == [[0, 1, 2], [3, 4, 5], [6]]
    assert len(pieces) == 0


def test_a_piece_that_killed_its_worker_comes_again_by_halves() -> None:
    pieces = Pieces(range(9), retries=2)
    piece = pieces.take(5)
    assert piece is not None
    assert pieces.lost(piece) is None
    assert len(pieces) == 9
    assert handed_out(pieces, 4) == [[0, 1], [2, 3, 4], [5, 6, 7, 8]]


def test_an_item_is_given_up_when_it_has_killed_one_worker_more_than_retries() -> None:
    pieces = Pieces(["a"], retries=2)
    given_up = []
    for _ in range(3):
        piece = pieces.take(1)
        assert piece is not None
        given_up.append(pieces.lost(piece))
    assert given_up == [None, None, "a"]
    assert pieces.take(1) is None


def test_one_bad_item_among_many_costs_no_other() -> None:
    pieces, done, given_up, deaths = Pieces(range(64), retries=2), [], [], 0
    while (piece := pieces.take(64)) is not None:
        if 37 in piece.items:
            deaths += 1
            lost = pieces.lost(piece)
            given_up += [] if lost is None else [lost]
        else:
            done += piece.items
    assert given_up == [37]
    assert sorted(done) == [i for i in range(64) if i != 37]
    assert deaths == 9  # log2(64) halvings, and three times alone


def test_dropped_pieces_are_not_handed_out() -> None:
    pieces = Pieces(range(7), retries=2)
    pieces.put_back(Piece(items=[9]))
    pieces.drop()
    assert len(pieces) == 0
    assert pieces.take(3) is None


def test_the_first_piece_is_one_item_and_later_ones_take_two_seconds() -> None:
    assert piece_size(1000, 2, None, 1) == 1
    assert piece_size(1000, 2, 0.1, 1) == 20
    assert piece_size(1000, 2, 0.1, 16) == 16
    assert piece_size(1000, 2, 5.0, 1) == 1


def test_the_last_pieces_are_small_so_that_workers_end_together() -> None:
    assert piece_size(40, 4, 0.001, 1) == 5
    assert piece_size(3, 4, 0.001, 1) == 1
