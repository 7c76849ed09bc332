import pytest

from v2p_data.scene.colour import colour_words
from v2p_data.scene.nouns import NOUNS, is_clear, noun_for
from v2p_data.scene.reconstruct import slug_for


@pytest.mark.parametrize(
    ("phrase", "word"),
    [
        ("red cracker box", "cracker box"),
        ("dark blue mug", "mug"),
        ("white watering can", "watering can"),
        ("coke cans", "coke can"),
        ("green boxes", "box"),
        ("lid of the pot", "pot"),
        ("flumph", ""),
    ],
)
def test_the_longest_known_words_of_a_phrase_name_the_noun(phrase, word):
    assert noun_for(phrase).word == word


def test_every_noun_is_a_thing_that_stands_on_a_table():
    for noun in NOUNS.values():
        assert all(0.001 <= s <= 0.6 for s in noun.size_m), noun.word
        density = noun.mass_kg / (noun.size_m[0] * noun.size_m[1] * noun.size_m[2])
        assert 5 < density < 5000, (noun.word, density)
        if noun.form != "box":
            assert noun.size_m[0] == noun.size_m[1]


def test_glass_can_be_seen_through_and_a_mug_cannot():
    assert is_clear("water bottle")
    assert is_clear("transparent cup")
    assert not is_clear("mug")


def test_a_phrase_names_its_colours_and_some_nouns_imply_one():
    assert colour_words("blue and yellow can") == ("blue", "yellow")
    assert colour_words("ripe tomato") == ("red",)
    assert colour_words("book") == ()


def test_names_are_unique_python_identifiers():
    assert slug_for("red snack box", set()) == "red_snack_box"
    assert slug_for("red snack box", {"red_snack_box"}) == "red_snack_box_2"
    assert slug_for("3M tape", set()) == "object_3m_tape"
    assert slug_for("class", set()) == "object_class"
    assert slug_for("…", set()) == "object"
