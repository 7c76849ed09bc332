"""Damaged and odd caption files, encodings included: each is a file name and its bytes, beside one video.

`REFUSED` must end in a sentence that names the file; `READ` gives the video this caption.
"""

import codecs
import json

PLAIN = "lift_red_box.mp4"
SAID = "Lifting red box up"
ROW = f"{PLAIN},{SAID}"
GERMAN = f"{PLAIN},Größere Büchse heben"
CSV, JSON = "captions.csv", "captions.json"


def _json(value: object) -> bytes:
    return json.dumps({PLAIN: value}).encode()


REFUSED: dict[str, tuple[str, bytes]] = {
    **{
        f"table in {encoding}": (CSV, GERMAN.encode(encoding))
        for encoding in (
            "latin-1",
            "cp1252",
            "cp850",
            "mac-roman",
            "utf-16",
            "utf-32",
            "utf-16-le",
            "utf-16-be",
            "cp037",
        )
    },
    "table in utf-16 of English": (CSV, ROW.encode("utf-16-le")),
    "table in utf-16 without its mark, big end": (CSV, ROW.encode("utf-16-be")),
    "table in Shift-JIS": (CSV, f"{PLAIN},赤い箱".encode("shift-jis")),
    "table in GB 18030": (CSV, f"{PLAIN},拿起红盒子".encode("gb18030")),
    "table in Big5": (CSV, f"{PLAIN},拿起紅盒子".encode("big5")),
    "table in KOI8-R": (CSV, f"{PLAIN},поднять коробку".encode("koi8-r")),
    "table cut inside a letter": (CSV, GERMAN.encode()[:-9] + b"\xc3"),
    "table of half characters": (CSV, ROW.encode() + b"\xed\xa0\xbd"),
    "table with a zero byte": (CSV, ROW.encode() + b"\0"),
    "table of zeros": (CSV, bytes(500)),
    "picture called a table": (CSV, b"\x89PNG\r\n\x1a\n" + bytes(range(256))),
    "packed table": (CSV, b"PK\x03\x04" + bytes(range(256))),
    "table with an open quotation mark": (CSV, f'{PLAIN},"{SAID}\n'.encode()),
    "table with a quotation mark inside": (CSV, f'{PLAIN},"Lifting "red" box"\n'.encode()),
    "table with a comma in a caption": (CSV, f"{ROW}, then down\n".encode()),
    "table of one column": (CSV, f"{PLAIN}\n".encode()),
    "table of three columns without titles": (CSV, f"{ROW},me\n".encode()),
    "table with titles and a comma in a caption": (CSV, f"file,caption\n{ROW}, up\n".encode()),
    "table with a row of another separator": (CSV, f"sep=;\n{ROW}\n".encode()),
    "rows of which one is text": ("captions.jsonl", f'{{"{PLAIN}": "up"}}\n"up"\n'.encode()),
    "rows of which one is cut": ("captions.jsonl", f'{{"{PLAIN}": "up"}}\n{{"b'.encode()),
    "rows with a file twice": ("captions.jsonl", f'{{"{PLAIN}": "up"}}\n'.encode() * 2),
    "rows without a caption": ("captions.jsonl", f'{{"file": "{PLAIN}"}}'.encode()),
    "rows in Latin-1": ("captions.jsonl", f'{{"{PLAIN}": "Größe"}}'.encode("latin-1")),
    "object in a text file, cut": ("captions.json.txt", _json(SAID)[:-1]),
    "table of Hugging Face with a path": ("metadata.csv", f"file_name,text\na/{ROW}".encode()),
    "table with an empty caption": (CSV, f"{PLAIN},\n".encode()),
    "table with a caption of dots": (CSV, f"{PLAIN},...\n".encode()),
    "table with a caption of a hidden letter": (CSV, f"{PLAIN},\u200b\u202e\n".encode()),
    "table with no name": (CSV, f",{SAID}\n".encode()),
    "table with a file twice": (CSV, f"{ROW}\n{ROW}\n".encode()),
    "table with a file that is not there": (CSV, f"other.mp4,{SAID}\n".encode()),
    "table with a path": (CSV, f"videos/{ROW}\n".encode()),
    "table with a path upwards": (CSV, f"../{ROW}\n".encode()),
    "table with a name that a terminal obeys": (CSV, f"\x1b[2J.mp4,{SAID}\n".encode()),
    "table with a cell of a megabyte": (CSV, f"{PLAIN},{'box ' * 300_000}\n".encode()),
    "table with a caption of a page": (CSV, f"{PLAIN},{'box ' * 600}\n".encode()),
    "table with titles twice": (CSV, f"file,caption\nfile,caption\n{ROW}\n".encode()),
    "table with semicolons and commas": (CSV, f"{PLAIN};Lifting; box\n".encode()),
    "table that is an object": (CSV, _json(SAID)),
    "table that is a page": (CSV, b"<html><body>404, not found</body></html>"),
    "table of lines ended by nothing known": (CSV, f"{ROW}\x85{ROW}".encode("latin-1")),
    "object in Latin-1": (JSON, f'{{"{PLAIN}": "Größe"}}'.encode("latin-1")),
    "object in UTF-16": (JSON, _json(SAID).decode().encode("utf-16")),
    "object in UTF-16 without its mark": (JSON, _json(SAID).decode().encode("utf-16-be")),
    "object in UTF-32": (JSON, _json(SAID).decode().encode("utf-32")),
    "object of zeros": (JSON, bytes(100)),
    "object cut in half": (JSON, _json(SAID)[:20]),
    "object without its end": (JSON, _json(SAID)[:-1]),
    "object twice": (JSON, _json(SAID) * 2),
    "object with a comma too many": (JSON, f'{{"{PLAIN}": "up",}}'.encode()),
    "object with a remark": (JSON, f'{{"{PLAIN}": "up"}} // mine'.encode()),
    "object in single quotes": (JSON, str({PLAIN: SAID}).encode()),
    "object of NaN": (JSON, f'{{"{PLAIN}": NaN}}'.encode()),
    "object of infinity": (JSON, f'{{"{PLAIN}": 1e999}}'.encode()),
    "object of true": (JSON, _json(True)),
    "object of lists": (JSON, _json([SAID])),
    "object of a caption of half a character": (JSON, _json("\ud83d")),
    "object of a caption of hidden letters": (JSON, _json("\u202e\u200b\U000e0041")),
    "object of a name of hidden letters": (JSON, json.dumps({"\u202e.mp4": SAID}).encode()),
    "object of objects without a caption": (JSON, _json({})),
    "object of a list of objects": (JSON, _json({"caption": SAID, "objects": {"a": 1}})),
    "object of an object of hidden letters": (
        JSON,
        _json({"caption": SAID, "objects": ["\u2060"]}),
    ),
    "object of two objects that differ in hidden letters": (
        JSON,
        _json({"caption": SAID, "objects": ["box", "b\u00adox"]}),
    ),
    "object of hints as text": (JSON, _json({"caption": SAID, "hints": "box"})),
    "text that is called an object": (JSON, SAID.encode()),
    "a number": (JSON, b"7"),
    "a deep list": (JSON, b"[" * 200_000),
    "a deep object": (JSON, b'{"a":' * 200_000),
}

READ: dict[str, tuple[str, bytes, str]] = {
    "table": (CSV, ROW.encode(), SAID),
    "table with titles": (CSV, f"file,caption\n{ROW}\n".encode(), SAID),
    "table with other titles": (CSV, f"Video, Caption\n{ROW}\n".encode(), SAID),
    "table with a byte order mark": (CSV, codecs.BOM_UTF8 + ROW.encode(), SAID),
    "table as Windows writes it": (
        CSV,
        codecs.BOM_UTF8 + f"file,caption\r\n{ROW}\r\n".encode(),
        SAID,
    ),
    "table with old line ends": (CSV, f"file,caption\r{ROW}\r".encode(), SAID),
    "table with semicolons": (
        CSV,
        f"file;caption\n{PLAIN};Lifting box, red\n".encode(),
        "Lifting box, red",
    ),
    "table with semicolons alone": (
        CSV,
        f"{PLAIN};Lifting box, red, up\n".encode(),
        "Lifting box, red, up",
    ),
    "table with tabs": (CSV, f"{PLAIN}\t{SAID}\n".encode(), SAID),
    "table with empty lines": (CSV, f"\n\n{ROW}\n,\n\n".encode(), SAID),
    "table with spaces": (CSV, f"  {PLAIN} ,  {SAID}  \n".encode(), SAID),
    "table with quotation marks": (
        CSV,
        f'"{PLAIN}","Lifting ""red"" box, up"\n'.encode(),
        'Lifting "red" box, up',
    ),
    "table with a caption of two lines": (CSV, f'{PLAIN},"Lifting\nred box up"\n'.encode(), SAID),
    "table with a formula": (CSV, f"{PLAIN},=Lifting red box\n".encode(), "=Lifting red box"),
    "table with more columns": (CSV, f"file,caption,by\n{ROW},me\n".encode(), SAID),
    "table of pandas": (CSV, f",file,caption\n0,{ROW}\n".encode(), SAID),
    "table of pandas, written twice": (
        CSV,
        f",Unnamed: 0,clip,caption\n0,0,{ROW}\n".encode(),
        SAID,
    ),
    "table of pandas without titles": (CSV, f"0,{ROW}\n".encode(), SAID),
    "table of Hugging Face": (CSV, f"file_name,text\n{ROW}\n".encode(), SAID),
    "table of Hugging Face, turned round": (
        CSV,
        f"text,file_name\n{SAID},{PLAIN}\n".encode(),
        SAID,
    ),
    "table of Excel": (
        CSV,
        codecs.BOM_UTF8 + f"sep=;\r\nfile;caption\r\n{PLAIN};Lifting box, red\r\n".encode(),
        "Lifting box, red",
    ),
    "list of rows": (JSON, json.dumps([{"file": PLAIN, "text": SAID}]).encode(), SAID),
    "Persian": (CSV, f"{PLAIN},می\u200cرود\n".encode(), "می\u200cرود"),
    "joined emoji": (JSON, _json(f"{SAID} 👩\u200d🍳"), f"{SAID} 👩\u200d🍳"),
    "hidden letters": (
        JSON,
        _json("Lif\u00adting\u202e red\u200b \U000e0068\U000e0069box\ufeff up"),
        SAID,
    ),
    "joiners at the ends of words": (
        JSON,
        _json("\u200dLifting\u200c \u200cred\u200c\u200d box up"),
        SAID,
    ),
    "wide spaces": (JSON, _json("Lifting\u00a0red\u3000box\u2028up\ue000"), SAID),
}

ALMOST: dict[str, bytes] = {
    "captions.json.txt": _json(SAID),
    "Captions.JSON": _json(SAID),
    "caption.json": _json(SAID),
    "captions.csv.txt": ROW.encode(),
    "captions.tsv": f"{PLAIN}\t{SAID}".encode(),
    "captions.jsonl": f'{{"file_name": "{PLAIN}", "text": "{SAID}"}}\n\n'.encode(),
    "captions.jsonl.txt": _json(SAID),
    "metadata.csv": f"file_name,text\n{ROW}".encode(),
    "metadata.jsonl": f'{{"file_name": "{PLAIN}", "text": "{SAID}"}}'.encode(),
}
"""Caption files that are almost rightly named: all are read, and named in a note."""
UNREAD = (
    "captions.txt",
    "captions (1).json",
    "my_captions.csv",
    "captions.xlsx",
    "captions.json.zip",
)
