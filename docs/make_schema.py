"""Write the JSON Schema of every published message into docs/schema/: python docs/make_schema.py"""

from pathlib import Path

from fusiond.messages import schemas

FOLDER = Path(__file__).parent / "schema"

if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in schemas():
        (FOLDER / name).write_bytes(text)
