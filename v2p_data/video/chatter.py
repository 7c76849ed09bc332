"""What people post around a caption and what names no object: links, tags, decorations, remarks on the filming.

A caption is cut into sentences and these into parts. What stands in round brackets, links, mentions, tags at the
ends and remarks go; the rest stays. The remarks are known in English, German, French, Spanish and Chinese.
"""

# ruff: noqa: RUF001 - the wide marks of Chinese are meant
import re
import unicodedata

_LINK = re.compile(
    r"(?:https?://|www\.)[^\s，。！]+|(?<![\w.])[a-z0-9-]+(?:\.[a-z0-9-]+)*\.(?:com|org|net|io|be|ly|co|me|tv|cc|gg|app|ee|de|fr|es|cn)(?:/[^\s，。！]*)?(?![\w])",
    re.IGNORECASE,
)
_MENTION = re.compile(r"(?<!\w)[@＠][\w.]*\w")
_TAG = r"[#＃]\w+"
_TAGS_AT_AN_END = re.compile(rf"^(?:\s*{_TAG})+|(?:\s*{_TAG})+\s*$")
_SENTENCE = re.compile(
    r"[|｜•·~～*^\n\ufffc]+|\.{2,}|…|\s[-–]\s|—|(?<!\S)[^\w\s]{2,}(?!\S)|(?<!\bno|\bnr|\bst|\bdr|\bmr|\bpt|\bep)(?<!\bvol|\bmrs)[.!?]+(?=\s|$)|[。！？]+|:(?=\s)|："
)
DECORATION = "(?<![\\s\ufffc\u200d])[\\s\u200d]*+\ufffc[\\s\ufffc\u200d]*+"
"""Pattern for emoji and arrows, as `sentences_of` marks them, with what is between them."""
_PART = re.compile(r"(\s*[,;，；、]\s*)")
"""Between parts; where both stay, it stays."""
_ASIDE = re.compile(r"([(\[（【])([^()\[\]（）【】]*)([)\]）】])")

_WORDS = [
    # quality and format
    r"(?:in |en |à |a )?(?:ultra )?(?:4|8)k(?: ?hdr)?|(?:in |en )?(?:full ?|ultra ?)?hd|uhd|hdr|\d{3,4}p|\d+ ?fps",
    r"pov|asmr|first[- ]person(?: view)?|第一(?:人称)?视角",
    r"(?:in |en |au |a |à |im )?(?:super )?(?:slow[- ]?mo(?:tion)?|zeitlupe|ralenti|cámara lenta|慢动作|慢镜头)",
    r"(?:in |als |en )?(?:time[- ]?lapse|hyperlapse|zeitraffer|accéléré|cámara rápida|延时(?:摄影)?)",
    r"(?:vertical|horizontal|portrait|landscape) (?:video|format)|hochformat|querformat|vidéo "
    r"verticale|v[ií]deo vertical|[竖横]屏",
    r"top[- ]view|bird'?s[- ]eye view|side view(?! mirror)|close[- ]?up|overhead "
    r"shot|draufsicht|nahaufnahme|seitenansicht|ansicht von oben",
    r"vue d[eu] (?:dessus|haut|côté)|gros plan|vista (?:desde "
    r"arriba|superior|lateral|cenital)|primer plano|[俯侧仰][拍视]|特写",
    r"(?:sound|audio|volume) (?:on|off|up)|(?:no|without) "
    r"(?:sound|audio|music|talking|cuts|edits?)|ohne (?:ton|musik|schnitt)",
    r"sans (?:le )?(?:son|musique|coupures?)|sin (?:sonido|audio|música|cortes)|[无没]有?(?:声音?|剪辑|配乐)",
    r"lol|haha+|lmao|omg|xd|ok(?:ay)?,? so|oc|unedited|uncut|raw footage|original "
    r"(?:sound|video)|handyvideo|ungeschnitten|non monté|sin editar|原声|未剪辑",
    r"(?:part|pt|teil|partie|parte|episode|ep|take|vol|folge|épisode|episodio|capítulo)\.? "
    r"?#?\d+(?:/\d+)?(?! (?:of|von|de)\b)|\d+(?:st|nd|rd|th) (?:try|take|attempt)|第 ?[\d一二三四五六七八九十]+ ?[集期部]",
]
"""Remarks of a word or two, which go wherever they stand."""

_ENDINGS = [
    r"(?:filmed|shot|recorded|captured|taken|made) (?:with|on|using|by|in|from) ",
    r"(?:mit|auf|per) [\w ]{0,30}(?:gefilmt|aufgenommen|gedreht)|(?:gefilmt|aufgenommen|gedreht) (?:mit|von|auf|in)",
    r"(?:filmée?|tournée?|enregistrée?) (?:avec|sur|par|au|à|en) ",
    r"(?:grabad[oa]|filmad[oa]) (?:con|en|por|desde) ",
    r"(?:用|拿)?\w{0,8}(?:手机|相机|gopro|iphone|华为|小米)\w{0,4}(?:拍|录)|\w{0,8}[拍录](?:的|摄)$",
]
"""Remarks that go on to the end of their part."""

_WHOLE = [
    r"(?:watch|stay|wait)(?: this)? (?:till|until|'?til|to|for) (?:the )?(?:very "
    r")?(?:end|it)|like (?:and|&) (?:subscribe|share|follow)",
    r"(?:don'?t forget to |please |pls )?(?:subscribe|follow (?:me|us|for)|like,? comment|smash "
    r"that)|link(?:s)? in (?:my |the )?(?:bio|description|comments?)",
    r"thanks? (?:you )?for watching|thx for watching|sorry (?:for|about) |(?:bad|poor|low) "
    r"(?:lighting|light|quality|camera)|shaky (?:cam|camera|video)",
    r"day \d+(?: of .*)?$|my first (?:video|clip|post|try)|test "
    r"(?:clip|video|footage)|(?:hope|if) you (?:like|enjoy)|credits? (?:to|goes)|not my video",
    r"bis zum (?:ende|schluss)|(?:link|links) (?:in|im) (?:der |meiner "
    r")?(?:bio|beschreibung|kommentar)|danke fürs? (?:zuschauen|zusehen|anschauen)",
    r"sorry (?:für|wegen)|entschuldigt|(?:schlechte|miese) "
    r"(?:qualität|beleuchtung)|(?:abo|like)s? (?:da ?lassen|nicht vergessen)|abonnier|folgt "
    r"(?:mir|uns)|mein erstes video|verwackelt",
    r"jusqu'?(?:à|au) (?:la )?(?:fin|bout)|attend(?:ez|s) (?:la|jusqu)|lien (?:en|dans (?:la|ma)) "
    r"(?:bio|description)|merci (?:d'avoir regardé|de regarder|à tous)",
    r"désolée? pour|mauvaise (?:qualité|lumière)|abonne[zr]?(?:-vous|-toi)?|n'oublie[zs]? "
    r"pas|(?:ma|mon) premi(?:ère|er) (?:vidéo|clip|essai)|likez|partagez",
    r"hasta el final|espera(?:d|n)? (?:al|a la|hasta)|(?:link|enlace) en (?:la |mi "
    r")?(?:bio|descripción|biografía)|gracias por (?:ver|mirar)|suscr[ií]b|síg(?:ueme|anme|uenos)",
    r"perdón por|disculp|mala (?:calidad|luz)|mi primer v[ií]deo|(?:dale|dejen?) (?:a )?(?:like|me gusta)|no olvides",
    r"(?:看|等|坚持)到?(?:最后|结尾|结局)|链接(?:在|见)|(?:谢谢|感谢)(?:大家)?(?:的)?(?:观看|收看|支持)|点赞|关注|订阅|转发|画质|光线(?:不好|太暗)|见谅|我的第一[个条次](?:视频|作品)?",
]
"""Remarks that take their whole part with them."""


def _any_of(patterns: list[str]) -> str:
    # beside letters of an alphabet a word ends; Chinese has no gaps
    return rf"(?<![^\W\u3400-\u9fff])(?:{'|'.join(patterns)})"


_REMARKS = re.compile(
    rf"{_any_of(_WORDS)}(?![^\W\u3400-\u9fff])|{_any_of(_ENDINGS)}.*$", re.IGNORECASE
)
_ALL_REMARK = re.compile(_any_of(_WHOLE), re.IGNORECASE)


def sentences_of(caption: str, inside: re.Pattern[str]) -> list[str]:
    """Return the sentences of a caption without what tells nothing of the scene; none where there is nothing else.

    A decoration parts two sentences, save where `inside` finds it within a phrase and keeps its group `open`.
    A tag between words stands for its word ("Put #sponge into the bowl").
    """
    caption = re.sub(r"[\d#*]\ufe0f?\u20e3", "\ufffc", caption)  # a key
    plain = "".join("\ufffc" if _is_decoration(c) else c for c in caption)
    plain = inside.sub(lambda found: f"{found['open'] or ''} ", plain)
    plain = _MENTION.sub(" ", _LINK.sub("|", plain))
    plain = _ASIDE.sub(_aside, plain)
    sentences = [_without_remarks(sentence) for sentence in _SENTENCE.split(plain)]
    return [s for s in sentences if _says(s)]


def _says(text: str) -> bool:
    return any(c.isalnum() for c in text)


def _is_decoration(char: str) -> bool:
    return unicodedata.category(char) in ("So", "Sk") or char in "\ufe0f→←↑↓➡"


def _aside(brackets: re.Match[str]) -> str:
    """Return what stays of a part in brackets: a place for an object, or an object that somebody listed."""
    is_place = brackets[1] == "[" and _says(_without_remarks(brackets[2]))
    return brackets[0] if is_place or "§" in brackets[2] else " "


def _without_remarks(sentence: str) -> str:
    sentence = _TAGS_AT_AN_END.sub("", sentence)
    pieces = _PART.split(re.sub(r"[#＃](?=\w)", "", sentence))
    kept = ""
    for between, piece in zip(["", *pieces[1::2]], pieces[::2], strict=True):
        part = "" if _ALL_REMARK.search(piece) else _REMARKS.sub(" ", piece)
        if part == piece or _says(part):
            kept += (between if kept else "") + part
    return " ".join(kept.split())
