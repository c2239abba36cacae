"""Tiny wheels for modules that LeRobot imports and a data set of pictures does not use: av, cv2."""
import sys, zipfile
from pathlib import Path
out = Path(sys.argv[1])
CODE = '''"""Stands in for a library that is imported and not used. Any use of it fails."""
class _Kind(type):
    def __getattr__(cls, name):
        if name.startswith("__"): raise AttributeError(name)
        return cls
    def __call__(cls, *args, **how): raise ImportError("%s is not installed here")
class Absent(metaclass=_Kind): pass
def __getattr__(name):
    if name.startswith("__"): raise AttributeError(name)
    return Absent
'''
AV = CODE + '''
# LeRobot checks the settings of its encoder also for a data set of pictures, which encodes nothing.
class _Checked:
    type, video_formats = "video", None
    class descriptor:
        class _None: name = "none"
        options = (_None,)
    def __init__(self, name, mode="r"): self.name = name
class codec: Codec = _Checked
class VideoFormat:
    components = (0, 1, 2)
    def __init__(self, name): self.name = name
'''
for dist, mod, version in (("av", "av", "15.0.0"), ("opencv_python_headless", "cv2", "4.12.0")):
    info = f"{dist}-{version}.dist-info"
    with zipfile.ZipFile(out / f"{dist}-{version}-py3-none-any.whl", "w") as w:
        w.writestr(f"{mod}/__init__.py", (AV if mod == "av" else CODE) % mod)
        w.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {dist.replace('_','-')}\nVersion: {version}\n")
        w.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: standin\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        w.writestr(f"{info}/RECORD", f"{mod}/__init__.py,,\n{info}/METADATA,,\n{info}/WHEEL,,\n{info}/RECORD,,\n")
