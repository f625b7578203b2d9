from probe_kit.models.decoding import Packed


def test_padding_stands_before_the_last_token_so_that_no_other_token_moves() -> None:
    packed = Packed.of([[1, 7, 8, 9, 10], [1, 7, 29]], padding=0)
    assert packed.ids.tolist() == [[1, 7, 8, 9, 10], [1, 7, 0, 0, 29]]
    assert packed.mask.tolist() == [[True] * 5, [True, True, False, False, True]]
