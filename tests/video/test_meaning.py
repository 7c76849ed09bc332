"""Captions and what they ask for, written out by hand."""

import itertools

import pytest
from posted_captions import JUDGED_ON, SEEN_LATER, TRIED_ON

from v2p_data.video.meaning import parse_caption

# What a person would write beside real clips: caption, objects, kind, manipulated, roles of the others.
REAL = [
    (
        "Putting orange ball into blue bowl",
        "orange ball; blue bowl",
        "insert",
        "orange ball",
        "blue bowl: container",
    ),
    (
        "Pushing plate from left to right next to brown box",
        "plate; brown box",
        "push_right",
        "plate",
        "brown box: reference",
    ),
    (
        "Pushing red snack box from left to right",
        "red snack box; brown box",
        "push_right",
        "red snack box",
        "brown box: reference",
    ),
    (
        "Tipping red snack box up against brown box",
        "red snack box; brown box",
        "tip_over",
        "red snack box",
        "brown box: reference",
    ),
    (
        "Putting plate into dish rack",
        "plate; dish rack",
        "insert",
        "plate",
        "dish rack: container",
    ),
    (
        "Lifting white watering can up",
        "white watering can; black pot",
        "lift_up",
        "white watering can",
        "black pot: reference",
    ),
    (
        "Pushing red snack box and tipping it up",
        "red snack box; brown box",
        "tip_over",
        "red snack box",
        "brown box: reference",
    ),
    (
        "Putting blue and yellow can onto black tray",
        "blue and yellow can; black tray",
        "place_onto",
        "blue and yellow can",
        "black tray: reference",
    ),
    (
        "Dropping card in front of matchbox",
        "card; matchbox",
        "drop_in_front_of",
        "card",
        "matchbox: reference",
    ),
    (
        "Pushing rubber duck from right to left",
        "rubber duck; tea box",
        "push_left",
        "rubber duck",
        "tea box: reference",
    ),
    ("Lifting pen up", "pen", "lift_up", "pen", ""),
    ("Pushing book from right to left", "book", "push_left", "book", ""),
    (
        "Putting red apple into green bowl",
        "red apple; green bowl",
        "insert",
        "red apple",
        "green bowl: container",
    ),
    ("Pushing white bin from left to right", "white bin", "push_right", "white bin", ""),
    (
        "Lifting dark blue mug up and putting it onto coaster",
        "dark blue mug; coaster",
        "place_onto",
        "dark blue mug",
        "coaster: reference",
    ),
    (
        "Putting red block into toy boat",
        "red block; toy boat",
        "insert",
        "red block",
        "toy boat: container",
    ),
    (
        "Putting mug onto coaster and boxes into tray",
        "mug; coaster; tray",
        "place_onto",
        "mug",
        "coaster: reference; tray: container",
    ),
    ("Lifting red cracker box up", "red cracker box", "lift_up", "red cracker box", ""),
    ("Covering jar with red lid", "red lid; jar", "place_onto", "red lid", "jar: reference"),
    ("Putting bread into toaster", "bread; toaster", "insert", "bread", "toaster: container"),
    (
        "Uncovering green cup by lifting orange cup",
        "orange cup; green cup",
        "uncover",
        "orange cup",
        "green cup: reference",
    ),
    ("Putting egg into orange pan", "egg; orange pan", "insert", "egg", "orange pan: container"),
    (
        "Covering yellow ball with red cup",
        "red cup; yellow ball",
        "cover",
        "red cup",
        "yellow ball: reference",
    ),
    ("Tipping bottle over", "bottle", "tip_over", "bottle", ""),
    (
        "Pushing chocolate bar next to red can",
        "chocolate bar; red can",
        "push_next_to",
        "chocolate bar",
        "red can: reference",
    ),
    (
        "Pushing green chip bag next to red can",
        "green chip bag; red can",
        "push_next_to",
        "green chip bag",
        "red can: reference",
    ),
    ("Putting can upright on the table", "red can", "generic", "red can", ""),
    ("Lifting cardboard box up", "cardboard box", "lift_up", "cardboard box", ""),
    ("Pushing sloth plush from left to right", "sloth plush", "push_right", "sloth plush", ""),
    ("Uncovering pot by lifting lid", "lid; pot", "uncover", "lid", "pot: reference"),
    (
        "Putting pens into mug with tongs",
        "pens; mug",
        "insert",
        "pens",
        "mug: container; tongs: tool",
    ),
    ("Squeezing paper package", "paper package", "generic", "paper package", ""),
]

# Templates of Something-Something-v2, free words and file names, without a list of objects.
FREE = [
    ("Pushing cup from left to right", "push_right", "cup", ""),
    ("Pushing cup from right to left", "push_left", "cup", ""),
    ("Pulling cup from left to right", "push_right", "cup", ""),
    ("Lifting cup up completely without letting it drop down", "lift_up", "cup", ""),
    ("Lifting cup up completely, then letting it drop down", "generic", "cup", ""),
    ("Lifting up one end of book without letting it drop down", "generic", None, ""),
    ("Lifting plate with apple on it", "lift_up", "plate", "apple: reference"),
    ("Tipping cup over", "tip_over", "cup", ""),
    (
        "Tipping cup with water in it over, so water in it falls out",
        "tip_over",
        "cup",
        "water: reference",
    ),
    ("Poking bottle so that it falls over", "tip_over", "bottle", ""),
    ("Pushing cup so that it almost falls off but doesn't", "generic", "cup", ""),
    ("Pushing cup so that it slightly moves", "generic", "cup", ""),
    ("Covering phone with cloth", "cover", "cloth", "phone: reference"),
    ("Uncovering phone", "uncover", "cover", "phone: reference"),
    ("Removing cup, revealing ball behind", "uncover", "cup", "ball: reference"),
    ("Taking lid off jar", "uncover", "lid", "jar: reference"),
    ("Pushing cup with pen", "push_with", "cup", "pen: tool"),
    ("Pushing cup next to can with pen", "push_next_to", "cup", "can: reference; pen: tool"),
    ("Moving cup closer to can", "push_next_to", "cup", "can: reference"),
    ("Dropping card in front of matchbox", "drop_in_front_of", "card", "matchbox: reference"),
    ("Putting cup into box", "insert", "cup", "box: container"),
    ("Putting cup onto box", "place_onto", "cup", "box: reference"),
    ("Putting cup next to box", "push_next_to", "cup", "box: reference"),
    ("Putting bottle upright on the table", "generic", "bottle", ""),
    ("Putting cup on a table", "generic", "cup", ""),
    ("Inserting key into lock", "insert", "key", "lock: container"),
    ("Throwing garlic into bowl", "throw_into", "garlic", "bowl: container"),
    ("Throwing ball in the air and catching it", "generic", "ball", ""),
    ("Sliding remote to mouse", "slide_to", "remote", "mouse: reference"),
    ("Pretending to put cup into box", "generic", "cup", "box: container"),
    ("Pushing something next to something", "push_next_to", "object", "other object: reference"),
    (
        "A person slowly pushes the blue and white box to the left.",
        "push_left",
        "blue and white box",
        "",
    ),
    ("Pushing the cup to the left of the plate", "push_next_to", "cup", "plate: reference"),
    (
        "pick up the red block and place it on the green block",
        "place_onto",
        "red block",
        "green block: reference",
    ),
    ("lift_up__red_box", "lift_up", "red box", ""),
    ("push left to right red box", "push_right", "red box", ""),
    ("red_box_lift", "lift_up", "red box", ""),
    ("tip over carton", "tip_over", "carton", ""),
    ("", "generic", "object", ""),
    # who acts, where, and which take it is, are no objects
    ("Lifting cup with my hand", "lift_up", "cup", ""),
    ("Pushing can with one finger from left to right", "push_right", "can", ""),
    ("Push the box by hand to the right", "push_right", "box", ""),
    ("Pushing cup with a pen in my left hand", "push_with", "cup", "pen: tool"),
    ("Pushing the cup with the palm of my hand", "generic", "cup", ""),
    ("Covering ball with both hands", "generic", "ball", ""),
    ("Covering ball with cloth in my hand", "cover", "cloth", "ball: reference"),
    ("Pushing cup next to hand cream", "push_next_to", "cup", "hand cream: reference"),
    ("Lifting red box up in my kitchen", "lift_up", "red box", ""),
    ("Putting spoon into mug in the living room", "insert", "spoon", "mug: container"),
    ("Pushing mug to the left at home", "push_left", "mug", ""),
    ("Pushing toy car on the wooden table", "generic", "toy car", ""),
    ("Putting block into toy kitchen", "insert", "block", "toy kitchen: container"),
    ("Lifting kitchen roll up", "lift_up", "kitchen roll", ""),
    ("up 2", "generic", "object", ""),
    ("Lifting box up 2", "lift_up", "box", ""),
    ("push can left 03", "push_left", "can", ""),
    ("Stacking cup 2 on cup 1", "place_onto", "cup 2", "cup 1: reference"),
    # a decoration within a phrase parts nothing
    ("Lifting red 🟥 box up", "lift_up", "red box", ""),
    ("Lifting a 👩\u200d🍳 red box up", "lift_up", "red box", ""),
    ("Putting red 🍎 apple into green 🥣 bowl", "insert", "red apple", "green bowl: container"),
    ("Putting cup 🥤 into box 📦", "insert", "cup", "box: container"),
    ("pushing mug ☕ left", "push_left", "mug", ""),
    ("Lifting 🟥 red box up 🎉 in the kitchen", "lift_up", "red box", ""),
    ("Lift red 1️⃣ box up", "lift_up", "red box", ""),
]


def roles(text):
    return tuple(tuple(part.split(": ")) for part in text.split("; ") if part)


@pytest.mark.parametrize(("caption", "objects", "kind", "manipulated", "others"), REAL)
def test_captions_of_real_clips_are_understood(caption, objects, kind, manipulated, others):
    meaning = parse_caption(caption, tuple(objects.split("; ")))

    assert (meaning.kind, meaning.manipulated, meaning.others) == (
        kind,
        manipulated,
        roles(others),
    )


@pytest.mark.parametrize(("caption", "kind", "manipulated", "others"), FREE)
def test_templates_and_free_words_are_understood(caption, kind, manipulated, others):
    meaning = parse_caption(caption)

    assert (meaning.kind, meaning.others) == (kind, roles(others))
    assert manipulated in (meaning.manipulated, None)


def test_the_kind_does_not_depend_on_the_list_of_objects():
    for caption, objects, kind, *_ in REAL:
        assert parse_caption(caption).kind == kind, caption
        assert parse_caption(caption.upper(), tuple(objects.split("; "))).kind == kind, caption


def test_an_object_whose_name_holds_a_preposition_stays_whole():
    meaning = parse_caption("pushing box on wheels next to cup", ("box on wheels", "cup"))

    assert (meaning.kind, meaning.manipulated) == ("push_next_to", "box on wheels")
    assert meaning.others == (("cup", "reference"),)


@pytest.mark.parametrize(
    ("language", "posted", "said"), [*TRIED_ON, *JUDGED_ON, *SEEN_LATER], ids=itertools.count()
)
def test_a_caption_as_people_post_it_is_read_like_its_own_words(language, posted, said):
    assert parse_caption(posted) == parse_caption(said)


def test_objects_that_somebody_listed_are_found_where_remarks_would_be():
    meaning = parse_caption("Pushing 4k camera next to #1 mug (pov)", ("4k camera", "#1 mug"))

    assert (meaning.manipulated, meaning.others) == ("4k camera", (("#1 mug", "reference"),))


@pytest.mark.parametrize(
    ("caption", "phrases"),
    [
        ("Lifting box no. 5 up", ("box no 5",)),
        ("Pushing book with phone", ("book", "phone")),
        ("Lifting up a can of Dr.Pepper", ("can of dr pepper",)),
        ("Pick up the cup. Place it on the red plate.", ("cup", "red plate")),
        ("Pushing watch next to sound box", ("watch", "sound box")),
        ("Lifting §3 up", ("3",)),
    ],
)
def test_words_that_look_like_remarks_stay_objects(caption, phrases):
    assert parse_caption(caption).phrases == phrases
