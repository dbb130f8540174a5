"""Small wrong changes to a Python file: what a slip of the hand would do to code full of signs, indices and transposes.

Left alone are texts, annotations, decorators and what only words an error: a change there is no wrong number.
"""

import ast
import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

COMPARISONS = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
EDGES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
ARITHMETIC = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
PAIRS = [
    ("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("nanmin", "nanmax"), ("any", "all"), ("sin", "cos"),
    ("fmin", "fmax"), ("floor", "ceil"), ("zeros", "ones"), ("zeros_like", "ones_like"), ("vstack", "hstack"),
]  # fmt: skip
TWINS = dict(PAIRS) | {second: first for first, second in PAIRS}
WRAPPERS = {  # f(x, ...) becomes x
    "abs", "sorted", "reversed", "sqrt", "square", "exp", "flip", "clip", "transpose", "swapaxes", "inv", "pinv",
    "deg2rad", "rad2deg", "radians", "degrees", "cumsum", "diff", "cholesky", "unique", "isfinite", "outer",
}  # fmt: skip
METHODS = {"transpose", "swapaxes", "clip", "strip", "copy", "conj"}  # x.f(...) becomes x
PRECAUTIONS = {"strict", "encoding", "dtype"}  # keywords that change nothing where the rest is right
TIMES = {"t", "now", "time", "elapsed", "period", "duration"}
PRECISE = {"array", "asarray", "empty", "linspace"}  # np.f(...) whose numbers may be of float32
UNORDERED = {"isinstance", "issubclass", "getattr", "hasattr", "zip", "min", "max", "minimum", "maximum", "allclose"}


@dataclass(frozen=True)
class Mutant:
    path: Path  # of the file
    function: str  # "function" or "Class.method"; "" at the top of the module or of a class
    operator: str
    line: int
    source: str  # of the whole file, changed
    was: str  # the lines that change, stripped of their indentation
    becomes: str
    nth: int = 0  # of those of its function that read the same

    @property
    def place(self) -> tuple[str, str]:
        return self.path.as_posix(), self.function

    @property
    def key(self) -> str:
        """The same as long as the function reads the same, wherever it stands in its file."""
        nth = f" ({self.nth})" if self.nth else ""
        return f"{self.path.as_posix()}:{self.function}{nth}:{self.was}:{self.becomes}"


def signatures(texts: Iterable[str]) -> dict[str, dict[str, bool]]:
    """Of the functions and classes of some files, by name: whether each parameter need not be given. Two functions of
    one name are left out."""
    found: dict[str, dict[str, bool]] = {}
    for text in texts:
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef):
                own = {x.target.id: x.value is not None for x in node.body if isinstance(x, ast.AnnAssign)}
            elif isinstance(node, ast.FunctionDef):
                given, defaults = node.args.args, node.args.defaults
                own = {arg.arg: k >= len(given) - len(defaults) for k, arg in enumerate(given)}
                own |= {a.arg: x is not None for a, x in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)}
                own.pop("self", None)
            else:
                continue
            found[node.name] = {} if node.name in found else own
    return found


def mutants(path: Path, text: str, known: Mapping[str, Mapping[str, bool]] | None = None) -> list[Mutant]:
    """All mutants of a file, in the order of its lines. known: `signatures` of what it calls."""
    data, starts = text.encode(), [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    found: dict[str, Mutant] = {}
    for function, node, replacement, operator in _changes(ast.parse(text), "", known or {}):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        new = ast.unparse(ast.fix_missing_locations(replacement))
        if isinstance(replacement, ast.expr) and not isinstance(replacement, _ATOMS):
            new = f"({new})"
        changed = (data[:begin] + new.encode() + data[end:]).decode()
        first, last = starts[node.lineno - 1], starts[node.end_lineno]
        was, becomes = data[first:last].decode(), (data[first:begin] + new.encode() + data[end:last]).decode()
        if new != ast.unparse(node):
            mutant = Mutant(path, function, operator, node.lineno, changed, _flat(was), _flat(becomes))
            found.setdefault(changed, mutant)
    alike: dict[str, int] = {}
    numbered = []
    for mutant in sorted(found.values(), key=lambda mutant: mutant.line):
        nth = alike[mutant.key] = alike.get(mutant.key, -1) + 1
        numbered.append(replace(mutant, nth=nth))
    return numbered


_ATOMS = (ast.Name, ast.Constant, ast.Attribute, ast.Call, ast.Subscript, ast.Slice, ast.Tuple, ast.List, ast.Dict)


def _flat(text: str) -> str:
    return "\n".join(line.strip() for line in text.strip().splitlines())


def _changes(
    node: ast.AST, function: str, known: Mapping[str, Mapping[str, bool]]
) -> Iterator[tuple[str, ast.AST, ast.AST, str]]:
    """(function, node, what takes its place, operator) for everything below a node."""
    for child in _children(node):
        inside = function
        if isinstance(child, ast.ClassDef | ast.FunctionDef) and (not function or isinstance(node, ast.ClassDef)):
            inside = f"{function}.{child.name}" if function else child.name
        if isinstance(child, ast.If):  # of a condition the test alone is changed
            for replacement, operator in _condition(child):
                yield inside, child.test, replacement, operator
        elif isinstance(child, ast.List) and isinstance(node, ast.Call) and "np." in ast.unparse(node.func):
            pass  # no array of that shape would be any use
        elif type(child) in _MAKERS:
            for replacement, operator in _MAKERS[type(child)](child):
                yield inside, child, replacement, operator
        if isinstance(child, ast.Call):
            for replacement in _shorter(child, known):
                yield inside, child, replacement, "argument not passed"
        yield from _changes(child, inside, known)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """What may be changed below a node: no texts, annotations, decorators, words of an error."""
    if isinstance(node, ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom):
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            if isinstance(child, ast.Assign) and ast.unparse(child.targets[0]) == "__all__":
                continue
            if isinstance(child, ast.Subscript) and ast.unparse(child.value) == "Callable":  # a type with a name
                continue
            if getattr(getattr(node, "func", None), "attr", "") == "reshape" and ast.unparse(child) == "-1":
                continue  # NumPy takes -2 for the same
            if isinstance(child, ast.AST) and getattr(child, "arg", None) not in PRECAUTIONS:
                yield child


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _compare(node: ast.Compare) -> Iterator[tuple[ast.AST, str]]:
    for k, operator in enumerate(node.ops):
        ops = [*node.ops]
        ops[k] = COMPARISONS[type(operator)]()
        yield _with(node, ops=ops), "comparison turned"
        counted = any(isinstance(part, ast.Constant) and type(part.value) is int for part in node.comparators)
        if type(operator) in EDGES and (counted or "len(" in ast.unparse(node)):  # of floats the edge is never met
            ops = [*node.ops]
            ops[k] = EDGES[type(operator)]()
            yield _with(node, ops=ops), "edge of a comparison"


def _binary(node: ast.BinOp) -> Iterator[tuple[ast.AST, str]]:
    if isinstance(node.left, ast.JoinedStr | ast.List | ast.Tuple) or isinstance(node.right, ast.JoinedStr | ast.List):
        return
    if isinstance(node.op, ast.MatMult):
        if ast.unparse(node.left) != ast.unparse(node.right):
            yield _with(node, left=node.right, right=node.left), "factors swapped"
    elif isinstance(node.op, ast.BitOr) and isinstance(node.right, ast.Dict):  # a copy with other values
        yield node.left, "entry dropped"
    elif type(node.op) in ARITHMETIC:
        yield _with(node, op=ARITHMETIC[type(node.op)]()), _kind(node.op)
        if isinstance(node.op, ast.Sub) and ast.unparse(node.right) == f"{ast.unparse(node.left)}[0]":
            yield node.left, "time base"


def _kind(operator: ast.operator) -> str:
    return "sign" if isinstance(operator, ast.Add | ast.Sub) else "arithmetic"


def _unary(node: ast.UnaryOp) -> Iterator[tuple[ast.AST, str]]:
    if not isinstance(node.op, ast.UAdd):
        yield node.operand, "not dropped" if isinstance(node.op, ast.Not) else "sign"


def _boolean(node: ast.BoolOp) -> Iterator[tuple[ast.AST, str]]:
    yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And()), "and, or"
    for k in range(len(node.values)):
        values = node.values[:k] + node.values[k + 1 :]
        yield values[0] if len(values) == 1 else _with(node, values=values), "operand dropped"


def _constant(node: ast.Constant) -> Iterator[tuple[ast.AST, str]]:
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value), "constant"
    elif isinstance(value, int):
        yield ast.Constant(value + 1), "constant"
    elif isinstance(value, float):
        yield ast.Constant(10 * value if value else 1.0), "constant"


def _choice(node: ast.IfExp) -> Iterator[tuple[ast.AST, str]]:
    yield _with(node, body=node.orelse, orelse=node.body), "choice swapped"
    yield node.orelse, "never true"


def _condition(node: ast.If) -> Iterator[tuple[ast.AST, str]]:
    if isinstance(node.body[-1], ast.Return | ast.Raise | ast.Continue | ast.Break) and not node.orelse:
        yield ast.Constant(False), "guard dropped"
        return
    yield ast.UnaryOp(ast.Not(), node.test), "condition turned"
    yield ast.Constant(False), "never true"


def _attribute(node: ast.Attribute) -> Iterator[tuple[ast.AST, str]]:
    if node.attr == "T":
        yield node.value, "transpose dropped"


def _call(node: ast.Call) -> Iterator[tuple[ast.AST, str]]:
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    module = ast.unparse(function.value) if isinstance(function, ast.Attribute) else ""
    free = isinstance(function, ast.Name) or module in ("np", "ca", "math", "np.linalg", "scipy.linalg", "linalg")
    if name in TWINS:
        twin = _with(function, **{"attr" if isinstance(function, ast.Attribute) else "id": TWINS[name]})
        yield _with(node, func=twin), "twin function"
    if name in WRAPPERS and free and node.args and not isinstance(node.args[0], ast.Starred):
        yield node.args[0], "function dropped"
    elif name in METHODS and not free and isinstance(function, ast.Attribute):
        yield function.value, "method dropped"
    for k, keyword in enumerate(node.keywords):
        if keyword.arg not in (None, *PRECAUTIONS) and not name[:1].isupper():
            yield _with(node, keywords=node.keywords[:k] + node.keywords[k + 1 :]), "keyword dropped"
    plain = len(node.args) == 2 and not any(isinstance(arg, ast.Starred | ast.Constant) for arg in node.args)
    if plain and not node.keywords and name not in UNORDERED:
        yield _with(node, args=node.args[::-1]), "arguments swapped"
    for k, arg in enumerate(node.args):
        if name != "len" and ast.unparse(arg).split(".")[-1] in TIMES:
            half = ast.BinOp(ast.Constant(0.5), ast.Mult(), arg)
            yield _with(node, args=[*node.args[:k], half, *node.args[k + 1 :]]), "time base"
    if name == "range" and len(node.args) < 3:
        first, last = [ast.Constant(0), *node.args][-2:]
        yield _with(node, args=[first, ast.BinOp(last, ast.Sub(), ast.Constant(1))]), "range by one"
        yield _with(node, args=[ast.BinOp(first, ast.Add(), ast.Constant(1)), last]), "range by one"
    if name == "default_rng" and node.args:
        seeds = node.args[0].elts if isinstance(node.args[0], ast.List | ast.Tuple) else node.args
        fewer = ast.List(seeds[:-1]) if len(seeds) > 1 else ast.Constant(0)
        yield _with(node, args=[fewer, *node.args[1:]]), "seed used twice"
    dtypes = [ast.unparse(keyword.value) for keyword in node.keywords if keyword.arg == "dtype"]
    if module == "np" and name in PRECISE and dtypes in ([], ["float"]):
        others = [keyword for keyword in node.keywords if keyword.arg != "dtype"]
        single = ast.keyword("dtype", ast.parse("np.float32", mode="eval").body)
        yield _with(node, keywords=[*others, single]), "float32"


def _shorter(node: ast.Call, known: Mapping[str, Mapping[str, bool]]) -> Iterator[ast.AST]:
    """A call without an argument that it need not give: the last by position, or one by name."""
    function = node.func
    parameters = known.get(function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", ""), {})
    given = len(node.args)
    last = list(parameters)[given - 1 : given]
    if given and last and parameters[last[0]] and not any(isinstance(arg, ast.Starred) for arg in node.args):
        yield _with(node, args=node.args[:-1])
    for k, keyword in enumerate(node.keywords):
        if parameters.get(keyword.arg or ""):
            yield _with(node, keywords=node.keywords[:k] + node.keywords[k + 1 :])


def _list(node: ast.List | ast.ListComp) -> Iterator[tuple[ast.AST, str]]:
    if isinstance(node, ast.ListComp):
        yield from _filtered(node)
    if isinstance(node, ast.ListComp) or (node.elts and isinstance(node.ctx, ast.Load)):
        yield ast.List([], ast.Load()), "list emptied"


def _dict(node: ast.Dict) -> Iterator[tuple[ast.AST, str]]:
    for k in range(len(node.keys) if len(node.keys) > 1 else 0):
        keys, values = (part[:k] + part[k + 1 :] for part in (node.keys, node.values))
        yield _with(node, keys=keys, values=values), "entry dropped"


def _subscript(node: ast.Subscript) -> Iterator[tuple[ast.AST, str]]:
    index = node.slice
    if isinstance(index, ast.Tuple) and len(index.elts) > 1:
        first, second, *rest = index.elts
        yield _with(node, slice=_with(index, elts=[second, first, *rest])), "indices swapped"


def _slice(node: ast.Slice) -> Iterator[tuple[ast.AST, str]]:
    for bound in ("lower", "upper", "step"):
        if getattr(node, bound) is not None:
            yield _with(node, **{bound: None}), "slice"


def _return(node: ast.Return) -> Iterator[tuple[ast.AST, str]]:
    if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield _with(node, value=None), "result dropped"


def _augmented(node: ast.AugAssign) -> Iterator[tuple[ast.AST, str]]:
    yield ast.Pass(), "statement dropped"
    if type(node.op) in ARITHMETIC:
        yield _with(node, op=ARITHMETIC[type(node.op)]()), _kind(node.op)


def _assignment(node: ast.Assign) -> Iterator[tuple[ast.AST, str]]:
    if isinstance(node.targets[0], ast.Attribute | ast.Subscript):
        yield ast.Pass(), "statement dropped"


def _expression(node: ast.Expr) -> Iterator[tuple[ast.AST, str]]:
    if isinstance(node.value, ast.Call):
        yield ast.Pass(), "statement dropped"


def _statement(node: ast.stmt) -> Iterator[tuple[ast.AST, str]]:
    yield ast.Pass(), "statement dropped"


def _filtered(node: ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp) -> Iterator[tuple[ast.AST, str]]:
    for k, loop in enumerate(node.generators):
        if loop.ifs:
            loops = [*node.generators]
            loops[k] = _with(loop, ifs=[])
            yield _with(node, generators=loops), "filter dropped"


_MAKERS = {
    ast.Compare: _compare, ast.BinOp: _binary, ast.UnaryOp: _unary, ast.BoolOp: _boolean, ast.Constant: _constant,
    ast.IfExp: _choice, ast.Attribute: _attribute, ast.Call: _call, ast.Subscript: _subscript,
    ast.Slice: _slice, ast.Return: _return, ast.AugAssign: _augmented, ast.Assign: _assignment, ast.Expr: _expression,
    ast.Raise: _statement, ast.Continue: _statement, ast.Break: _statement, ast.ListComp: _list, ast.List: _list,
    ast.Dict: _dict, ast.SetComp: _filtered, ast.GeneratorExp: _filtered, ast.DictComp: _filtered,
}  # fmt: skip
