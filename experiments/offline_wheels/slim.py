"""Rebuild wheels without what the demonstration does not need, into the folder given."""
import base64, hashlib, io, re, sys, zipfile
from pathlib import Path
from PIL import Image
whl, out = Path("whl"), Path(sys.argv[1])
out.mkdir(exist_ok=True)
for old in out.glob("*.whl"): old.unlink()

def closure(z):
    base = "metaworld/assets/"
    names = set(z.namelist())
    todo = [base + "sawyer_xyz/" + n for n in ("sawyer_reach_v3.xml", "sawyer_button_press.xml", "sawyer_drawer.xml", "sawyer_door_pull.xml")]
    used = set()
    bases = {n.rsplit("/", 1)[-1]: [] for n in names}
    for n in names: bases[n.rsplit("/", 1)[-1]].append(n)
    while todo:
        n = todo.pop()
        if n in used: continue
        used.add(n)
        if n.endswith(".xml"):
            text = z.read(n).decode()
            for f in re.findall(r'file="([^"]+)"', text):
                todo += [m for m in bases.get(f.rsplit("/", 1)[-1], []) if m.startswith(base)]
    return used

def slim(path):
    z = zipfile.ZipFile(path)
    keep = lambda n: True
    if path.name.startswith("metaworld"):
        used = closure(z)
        keep = lambda n: not n.startswith("metaworld/assets/") or n in used
    elif path.name.startswith("mujoco-3"):
        keep = lambda n: "/experimental/" not in n and "_render_filament" not in n
    elif path.name.startswith("mujoco_mjx"):
        keep = lambda n: "test_data" not in n
    elif path.name.startswith(("pandas", "brax")):
        keep = lambda n: "/tests/" not in n and not re.search(r"brax/(test_data|envs/assets)/.*\.(stl|png|obj)$", n)
    rows, target = [], out / path.name
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as w:
        record = None
        for info in z.infolist():
            n = info.filename
            if n.endswith("/") or not keep(n): continue
            if n.endswith(".dist-info/RECORD"): record = n; continue
            data = z.read(n)
            if path.name.startswith("metaworld") and n.endswith((".png", ".jpeg")) and len(data) > 60000:
                picture = Image.open(io.BytesIO(data)).convert("RGB"); picture.thumbnail((384, 384))
                # textures of a cube stay as they are, MuJoCo asks for a shape
                b = io.BytesIO(); picture.save(b, "PNG" if n.endswith("png") else "JPEG"); data = b.getvalue()
            new = zipfile.ZipInfo(n, (2026,1,1,0,0,0)); new.external_attr = info.external_attr; new.compress_type = zipfile.ZIP_DEFLATED
            w.writestr(new, data)
            rows.append(f"{n},sha256={base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b'=').decode()},{len(data)}")
        w.writestr(record, "\n".join([*rows, f"{record},,"]) + "\n")
    return target.stat().st_size
total = 0
skip = tuple(sys.argv[2:])
for p in sorted(whl.glob("*.whl")):
    if p.name.startswith(skip): continue
    s = slim(p); total += s
    if s > 200000: print(p.name, s)
print("total", total)
