import math
import re
from collections import Counter
from pathlib import Path

import pytest

from v2p_data.errors import V2PError
from v2p_data.scene.estimates import slug_for
from v2p_data.scene.frames.colour import colour_words
from v2p_data.scene.scale.nouns import (
    COLUMNS,
    FALLBACK,
    NOUNS,
    TABLE,
    Noun,
    is_clear,
    noun_for,
    read_nouns,
)

DOCS = Path(__file__).parents[3] / "docs" / "nouns.md"
GOOD_ROW = {
    "noun": "brolly",
    "form": "box",
    "length_cm": "27",
    "width_cm": "5",
    "height_cm": "5",
    "spread": "0.25",
    "mass_g": "350",
    "friction": "0.5",
    "hollow": "0",
    "taper": "1",
    "matter": "rigid",
    "colour": "black",
    "symmetric": "none",
    "synonyms": "parasol,sun shade",
    "source": "estimate",
}


def table_with(**changed: str) -> str:
    return "\t".join(COLUMNS) + "\n" + "\t".join((GOOD_ROW | changed).values()) + "\n"


def density(noun: Noun) -> float:
    """Mass over the volume of the outer shape [g/cm3]."""
    length, width, height = (100 * side for side in noun.size_m)
    small = min(noun.taper, 1 / noun.taper)
    frustum = math.pi / 4 * (1 + small + small**2) / 3
    fill = {"box": 1.0, "cylinder": frustum, "sphere": math.pi / 6}[noun.form]
    return 1000 * noun.mass_kg / (fill * length * width * height)


@pytest.mark.parametrize(
    ("phrase", "word"),
    [
        ("red cracker box", "cracker box"),
        ("dark blue mug", "mug"),
        ("a red cup", "cup"),
        ("white watering can", "watering can"),
        ("blue and yellow can", "can"),
        ("remote control", "remote"),
        ("mobile phone", "phone"),
        ("cell phone charger", "charger"),
        ("wrist watch", "watch"),
        ("plastic bottle", "bottle"),
        ("bottle cap", "bottle cap"),
        ("tea spoon", "teaspoon"),
        ("teaspoon", "teaspoon"),
        ("chocolate box", "box"),
        ("toy car", "toy car"),
        ("orange cup", "cup"),
        ("glass jar", "mason jar"),
        ("3M tape", "tape"),
        ("AA battery", "aa battery"),
        ("Rubik's cube", "rubiks cube"),
        ("sloth plush", "plush"),
        ("flumph", ""),
        ("orange thing", ""),
        ("", ""),
    ],
)
def test_the_last_noun_of_a_phrase_in_its_longest_form_is_what_it_is_about(phrase, word):
    assert noun_for(phrase).word == word


@pytest.mark.parametrize(
    ("phrase", "word"),
    [
        ("box of tissues", "tissue box"),
        ("box of chocolates", "box"),
        ("bottle of nail polish", "nail polish"),
        ("lid of the pot", "pot lid"),
        ("top of a bottle", "bottle cap"),
        ("stack of books", "book"),
        ("pair of scissors", "scissors"),
        ("slice of bread", "bread"),
        ("roll of toilet paper", "toilet paper"),
        ("cup of flumphs", "cup"),
    ],
)
def test_of_makes_a_compound_counts_or_adds_what_is_inside(phrase, word):
    assert noun_for(phrase).word == word


@pytest.mark.parametrize(
    ("phrase", "word"),
    [
        ("cup with a lid", "cup"),
        ("spoon on a plate", "spoon"),
        ("bottle that is full of water", "bottle"),
        ("can upright", "can"),
        ("pen and paper", "pen"),
    ],
)
def test_what_follows_a_preposition_is_not_the_object(phrase, word):
    assert noun_for(phrase).word == word


@pytest.mark.parametrize(
    ("plural", "word"),
    [
        ("coke cans", "coke can"),
        ("green boxes", "box"),
        ("shoes", "shoe"),
        ("glasses", "glasses"),
        ("knives", "knife"),
        ("batteries", "battery"),
        ("tomatoes", "tomato"),
        ("toothbrushes", "toothbrush"),
        ("dice", "die"),
        ("pens", "pen"),
        ("chopstick", "chopsticks"),
        ("mice", "mouse"),
        ("loaves", "bread loaf"),
    ],
)
def test_plurals_are_known(plural, word):
    assert noun_for(plural).word == word


def test_what_people_move_on_tables_in_something_something_is_known():
    labels = """pen bottle box paper book cup phone remote marker spoon wallet scissors key card mug bowl glass ball pencil toy usb
        plate lighter mouse notebook battery knife fork comb coin charger tissue matchbox lid bag cellphone watch tape glue eraser
        calculator toothbrush candle lipstick sharpener perfume deodorant stapler pendrive ring earphones headphones laptop powerbank
        flashlight torch screwdriver sponge highlighter sunglasses spectacles sock shoe slipper pillow cushion towel handkerchief
        adapter crayon paintbrush hammer nail screw bolt pliers wrench padlock lock bracelet belt hat glove purse pouch envelope folder
        file newspaper magazine keyboard mousepad tablet speaker camera umbrella vase flower plant pot pan kettle jug pitcher tumbler
        teacup saucer tray basket bin bucket spatula ladle whisk grater peeler sieve funnel jar tin can carton chocolate candy biscuit
        bread bun cake cheese butter sausage carrot cucumber pepper corn eggplant avocado mango pear peach plum kiwi grapes strawberry
        walnut pistachio potato onion garlic lemon egg orange apple banana tomato doll marble lego dice chalk ruler thread needle
        clothespin hanger mirror magnet stone shell feather leaf clock lamp tongs straw toothpick chopstick blanket cable wire rope"""

    assert [label for label in labels.split() if not noun_for(label).known] == []


def test_there_are_hundreds_of_nouns_and_every_word_leads_to_its_own():
    nouns, index = read_nouns(TABLE.read_text(), TABLE.name)

    assert len(nouns) >= 450
    assert nouns == NOUNS
    assert {word: noun_for(word).word for word in index} == {
        word: noun.word for word, noun in index.items()
    }


def test_every_noun_could_stand_on_a_table():
    # Soft things are folded, crumpled or full of air; hollow ones hold more of it than of themselves.
    for noun in NOUNS.values():
        lightest = 0.0003 if noun.matter == "soft" else 0.01 if noun.hollow else 0.02

        assert 0.003 <= max(noun.size_m) <= 0.8, noun.word
        assert min(noun.size_m) >= 0.001, noun.word
        assert lightest < density(noun) < 9, (noun.word, density(noun))
        assert 0.02 <= noun.spread <= 0.6, noun.word
        assert 0.05 <= noun.friction <= 1, noun.word


def test_an_estimate_does_not_claim_to_be_precise():
    assert [
        n.word for n in NOUNS.values() if n.source.startswith("estimate") and n.spread < 0.2
    ] == []


def test_standards_are_quoted_to_the_millimetre():
    sides_mm = {
        "credit card": (85.6, 54.0),
        "paper": (297.0, 210.0),
        "envelope": (220.0, 110.0),
        "passport": (125.0, 88.0),
        "aaa battery": (10.5, 44.5),
        "table tennis ball": (40.0, 40.0),
        "one euro coin": (23.25, 2.33),
        "quarter": (24.26, 1.75),
        "ice hockey puck": (76.2, 25.4),
        "billiard ball": (57.15, 57.15),
    }
    for word, sides in sides_mm.items():
        size_mm = sorted(1000 * side for side in NOUNS[word].size_m)
        assert all(min(abs(side - s) for s in size_mm) <= 1 for side in sides), word


def test_a_handle_or_spout_takes_symmetry_away():
    assert noun_for("bowl").symmetry == "round"
    assert noun_for("mug").symmetry == "none"
    assert noun_for("tennis ball").symmetry == "sphere"
    assert noun_for("book").symmetry == "box"
    assert FALLBACK.symmetry == "none"


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"mass_g": "heavy"}, "mass_g 'heavy' is not a number"),
        ({"height_cm": "0"}, "height_cm must be positive"),
        ({"spread": "nan"}, "spread must be positive"),
        ({"form": "cone"}, "form 'cone' is none of box, cylinder, sphere"),
        ({"form": "sphere", "symmetric": "sphere"}, "one diameter"),
        ({"hollow": "yes"}, "not 0 or 1"),
        ({"hollow": "0.6"}, "not 0 or 1"),
        ({"taper": "0.5"}, "only solids of revolution taper"),
        ({"colour": "mauve"}, "'mauve' is no colour"),
        ({"symmetric": "round"}, "cannot have the symmetry 'round'"),
        ({"source": "hearsay"}, "source 'hearsay' is none of"),
        ({"synonyms": "Parasol"}, "'Parasol' must be lower-case"),
        ({"source": "estimate\tmore"}, "it has 16 cells, not 15"),
    ],
)
def test_a_broken_row_is_named(changed, said):
    with pytest.raises(V2PError, match=r"^mine\.tsv:2, the row of 'brolly': ") as raised:
        read_nouns(table_with(**changed), "mine.tsv")

    assert said in str(raised.value)


def test_a_table_with_other_columns_or_a_word_twice_is_refused():
    row = table_with().splitlines()[1]

    assert list(read_nouns(table_with(), "mine.tsv")[1]) == ["brolly", "parasol", "sun shade"]
    with pytest.raises(V2PError, match=r"mine\.tsv:3, the row of 'parasol': 'parasol' is taken"):
        read_nouns(table_with() + row.replace("brolly", "parasol", 1), "mine.tsv")
    for text in ("", "noun\tform\n"):
        with pytest.raises(V2PError, match=r"mine\.tsv:1 must name these columns"):
            read_nouns(text, "mine.tsv")


def test_the_docs_count_the_sources():
    counted = dict(re.findall(r"^\| `(\w+)` \| (\d+) \|", DOCS.read_text(), re.M))

    assert {kind: int(number) for kind, number in counted.items()} == Counter(
        noun.source.partition(":")[0] for noun in NOUNS.values()
    )


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
