"""Code whose values reach shards takes nothing that rounds otherwise on another processor: read from the syntax trees.

What may stand in for what is refused: `augkitti.same_math`. A square counts as a product unless what is squared is
evidently a single number, whose power the C library takes. What a permission says is why no bit of a shard can differ.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent / "augkitti"
BEGIN = ("augmentation", "cad_models", "kitti", "parametric_cars", "shards", "synthesize")  # what stages call

PLATFORM = """
    sin cos tan sinc arcsin arccos arctan arctan2 asin acos atan atan2 angle phase polar rect
    sinh cosh tanh arcsinh arccosh arctanh asinh acosh atanh hypot dist
    exp exp2 expm1 log log2 log10 log1p logaddexp logaddexp2 geomspace logspace pow power float_power cbrt
    gamma lgamma erf erfc i0 hanning hamming blackman bartlett kaiser
    dot vdot inner outer matmul vecdot matvec vecmat tensordot einsum convolve correlate cov corrcoef
    polyfit poly vander
"""  # of numpy and math: the C library's, the processor's, or BLAS's
DRAWS = """
    exponential standard_exponential gamma standard_gamma beta lognormal vonmises poisson binomial rayleigh weibull
    laplace logistic gumbel pareto chisquare wald zipf geometric multivariate_normal dirichlet
"""  # of a generator: through the C library's logarithm, exponential or power at every draw
WHOLE = ("numpy.linalg.", "numpy.fft.", "numpy.polynomial.", "cmath.", "scipy.", "small_gicp.", "embreex.", "trimesh.")
LIBRARY = {  # where a library may be used: anywhere, for these reasons
    "scipy.ndimage.binary_closing": "no rounding",
    "scipy.ndimage.binary_dilation": "no rounding",
    "scipy.ndimage.label": "no rounding",
    "scipy.ndimage.minimum_filter": "no rounding",
    "scipy.ndimage.maximum_filter1d": "no rounding",
    "scipy.ndimage.convolve1d": "compiled sums and products in one order",
    "scipy.ndimage.correlate1d": "compiled sums and products in one order",
    "scipy.ndimage.uniform_filter": "compiled sums in one order",
    "scipy.ndimage.distance_transform_edt": "compiled squares, sums and square roots",
    "scipy.sparse.coo_array": "no rounding",
    "scipy.sparse.csgraph.connected_components": "no rounding",
    "scipy.spatial.cKDTree": "compiled differences, squares and square roots",
    "scipy.signal.lfilter": "compiled sums and products in one order",
    "scipy.special.expit": "left to SciPy: docs/reliability.md",
    "scipy.special.ndtr": "left to SciPy: docs/reliability.md",
    "scipy.special.ndtri": "left to SciPy: docs/reliability.md",
    "small_gicp": "a registered motion is rounded to a nanometre: docs/reliability.md",
    "embreex": "chooses triangles; hits are computed again in float64: docs/reliability.md",
    "trimesh": "reads files; of nested nodes it multiplies the transforms by BLAS: docs/reliability.md",
}
ALLOWED = {  # module and function: what, and why
    ("cad_formats", "_textured"): ({"numpy.einsum"}, "numpy's own loops of the lowest instruction set; only >= SOLID"),
    ("street_objects", "tree"): ({"**"}, "an array to the power 0.5: numpy takes the square root"),
}


class Module:
    """A module's tree, its imports by local name, and the names that are evidently single numbers."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.tree = name, ast.parse(text)
        self.whole = {  # constants of the module whose squares are exact, whoever takes them
            target.id
            for node in self.tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            if isinstance(node.value.value, int | float) and node.value.value % 1 == 0
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        self.imports: dict[str, str] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    top = alias.name.partition(".")[0]
                    self.imports[alias.asname or top] = alias.name if alias.asname else top
            elif isinstance(node, ast.ImportFrom):
                self.imports |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}

    def needs(self) -> set[str]:
        words = {word for place in self.imports.values() for word in place.split(".")[:2]}
        return {path.stem for path in ROOT.glob("*.py")} & words

    def dotted(self, node: ast.AST) -> str:
        """The full name of what is imported, empty for anything else."""
        if isinstance(node, ast.Name):
            return self.imports.get(node.id, "")
        if isinstance(node, ast.Attribute):
            base = self.dotted(node.value)
            return f"{base}.{node.attr}" if base else ""
        return ""

    def numbers_in(self, function: ast.AST, fields: set[str]) -> set[str]:
        """Names that a function takes as numbers, or goes through one by one."""
        found = set()
        for node in ast.walk(function):
            if isinstance(node, ast.arg) and node.annotation and ast.unparse(node.annotation) in ("float", "int"):
                found.add(node.arg)
            elif isinstance(node, ast.For | ast.comprehension):
                found |= {name.id for name in ast.walk(node.target) if isinstance(name, ast.Name)}
            elif isinstance(node, ast.Assign) and is_number(node.value, found, fields):
                found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        return found

    def offences(self, fields: set[str]) -> list[tuple[str, str, int]]:
        """Function, what it takes that it should not, and the line."""
        found: list[tuple[str, str, int]] = []

        def look(node: ast.AST, function: str, numbers: set[str]) -> None:
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.FunctionDef | ast.ClassDef):
                    inner = self.numbers_in(child, fields) if isinstance(child, ast.FunctionDef) else set()
                    look(child, f"{function}.{child.name}".strip("."), numbers | inner)
                    continue
                what = self.refused(child, numbers, fields)
                if what:
                    found.append((function, what, child.lineno))
                if not (isinstance(child, ast.Attribute) and self.dotted(child)):  # a full name is told once
                    look(child, function, numbers)

        look(self.tree, "", set())
        return found

    def refused(self, node: ast.AST, numbers: set[str], fields: set[str]) -> str:
        if isinstance(node, ast.BinOp | ast.AugAssign):
            if isinstance(node.op, ast.MatMult):
                return "@"
            if isinstance(node.op, ast.Pow):
                base, exponent = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.target, node.value)
                whole = (isinstance(base, ast.Constant) and isinstance(base.value, int)) or (
                    isinstance(base, ast.Name) and base.id in self.whole
                )
                square = isinstance(exponent, ast.Constant) and exponent.value == 2
                return "" if whole or (square and not is_number(base, numbers, fields)) else "**"
            return ""
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "pow":
            return "pow"
        if not isinstance(node, ast.Attribute | ast.Name):
            return ""
        name = self.dotted(node)
        if not name:  # a method of an array or of a generator
            return node.attr if isinstance(node, ast.Attribute) and node.attr in {"dot", *DRAWS.split()} else ""
        top, _, rest = name.partition(".")
        if top in ("numpy", "math") and rest in PLATFORM.split():
            return name
        known = any(name == one or name.startswith(f"{one}.") for one in LIBRARY)
        return name if name.startswith(WHOLE) and not known and not self.leads_on(name) else ""

    def leads_on(self, name: str) -> bool:
        """Whether a name is the beginning of one that is known."""
        return any(one.startswith(f"{name}.") for one in LIBRARY)


def is_number(node: ast.AST, numbers: set[str], fields: set[str]) -> bool:
    """Whether an expression is evidently a single number."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float)
    if isinstance(node, ast.Name):
        return node.id in numbers or node.id.isupper()
    if isinstance(node, ast.Attribute):
        return node.attr in fields
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand, numbers, fields)
    if isinstance(node, ast.BinOp):
        return is_number(node.left, numbers, fields) and is_number(node.right, numbers, fields)
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "float"


def reached() -> dict[str, Module]:
    """The modules that stages call, and all that those import."""
    found: dict[str, Module] = {}
    waiting = [*BEGIN]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = Module(name, (ROOT / f"{name}.py").read_text())
            waiting += found[name].needs()
    return found


MODULES = reached()
FIELDS = {  # of classes, annotated as numbers
    item.target.id
    for module in MODULES.values()
    for node in ast.walk(module.tree)
    if isinstance(node, ast.ClassDef)
    for item in node.body
    if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
    if ast.unparse(item.annotation) in ("float", "int")
}


@pytest.mark.parametrize("name", sorted(MODULES.keys() - {"same_math"}))
def test_no_value_comes_from_a_function_that_rounds_otherwise_elsewhere(name):
    bad = [
        f"augkitti/{name}.py:{line} {function}: {what}"
        for function, what, line in MODULES[name].offences(FIELDS)
        if what not in ALLOWED.get((name, function), ((),))[0]
    ]
    assert not bad, "\n".join(bad)


def test_no_permission_is_left_over():
    taken = {(name, function, what) for name in MODULES for function, what, _ in MODULES[name].offences(FIELDS)}
    assert {(*key, what) for key, (whats, _) in ALLOWED.items() for what in whats} <= taken
    named = {m.dotted(n) for m in MODULES.values() for n in ast.walk(m.tree) if isinstance(n, ast.Attribute | ast.Name)}
    assert {one for one in LIBRARY if not any(f"{name}.".startswith(f"{one}.") for name in named)} == set()


def test_what_makes_pairs_is_looked_at_and_what_draws_and_judges_them_is_not():
    assert {"placement", "sensor_noise", "street", "vehicle_motion", "cad_axes", "frames"} <= MODULES.keys()
    assert not {"draw", "validate", "dataset_info"} & MODULES.keys()


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("np.sin(x)", "numpy.sin"),
        ("math.hypot(x, y)", "math.hypot"),
        ("sine(x)", "math.sin"),
        ("np.linalg.norm(x)", "numpy.linalg.norm"),
        ("R @ x", "@"),
        ("x.dot(y)", "dot"),
        ("x**3", "**"),
        ("number**2", "**"),
        ("(2.0 * self.width_m) ** 2", "**"),
        ("ndimage.gaussian_filter(x, 1.0)", "scipy.ndimage.gaussian_filter"),
        ("Rotation.from_euler('z', x)", "scipy.spatial.transform.Rotation.from_euler"),
        ("rng.gamma(2.0)", "gamma"),
        ("sm.sin(x) + np.sqrt(x**2) + 10**9 + ndimage.label(x)[0] + (x - number) ** 2", None),
    ],
)
def test_the_checker_sees(line, what):
    text = (
        "import math\nimport numpy as np\nfrom math import sin as sine\nfrom scipy import ndimage\n"
        "from scipy.spatial.transform import Rotation\nfrom augkitti import same_math as sm\n"
        f"def f(self, x, y, R, rng, number: float):\n    return {line}\n"
    )
    assert [found for _, found, _ in Module("any", text).offences({"width_m"})] == ([what] if what else [])
