"""Small products and inverses in compiled code, by the routines that numba and numpy call.

numba's ``np.dot``, ``np.linalg.inv`` and ``np.linalg.pinv`` allocate their results, check their
arguments and ask LAPACK for the size of its workspace at every call. For the matrices of an arm
that takes longer than the calculation. Here it is done once: the arguments of every call are
addresses that stay the same. The routines (numba's are scipy's) and their arguments are the same,
and so the results are the same bits.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrl_bmrl.envs.caching import cached_njit
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import scipy.linalg.cython_blas
    import scipy.linalg.cython_lapack  # noqa: F401 (their functions are found by name)
    from llvmlite import binding
    from numba import types
    from numba.extending import get_cython_function_address

_ROUTINES = {
    "dgemm": ("cython_blas", 13),
    "dgemv": ("cython_blas", 11),
    "dgetrf": ("cython_lapack", 6),
    "dgetri": ("cython_lapack", 7),
    "dgesdd": ("cython_lapack", 14),
}
"""Fortran routines of scipy: their module and number of arguments, all addresses."""


def _external(name: str, address: int, signature: Any) -> Any:
    """A function for compiled code, which finds it by name."""
    binding.add_symbol(f"torchrl_bmrl_{name}", address)
    return types.ExternalFunction(f"torchrl_bmrl_{name}", signature)


def _address(name: str) -> int:
    return get_cython_function_address(f"scipy.linalg.{_ROUTINES[name][0]}", name)


_dgemm, _dgemv, _dgetrf, _dgetri, _dgesdd = (
    _external(name, _address(name), types.void(*[types.uintp] * count))
    for name, (_, count) in _ROUTINES.items()
)


def _find_dgemv() -> int:
    """Address of numpy's own matrix-vector product; 0 for a numpy that is built in another way."""
    for path in Path(np.__file__).parents[1].glob("numpy.libs/libopenblas64_*"):
        library = ctypes.CDLL(str(path))  # numpy has loaded it
        if hasattr(library, "cblas_dgemv64_"):
            return ctypes.cast(library.cblas_dgemv64_, ctypes.c_void_p).value or 0
    return 0


NUMPYS_DGEMV = _find_dgemv()
_numpys_dgemv = _external(
    "numpys_dgemv",
    NUMPYS_DGEMV or _address("dgemm"),  # never called without numpy's
    types.void(
        *[types.int32] * 2,  # order of the matrix, transposition
        *[types.int64] * 2,  # rows, columns
        types.float64,
        types.uintp,  # matrix
        types.int64,
        types.uintp,  # vector
        types.int64,
        types.float64,
        types.uintp,  # result
        types.int64,
    ),
)
_py_call = types.ExternalFunction("PyObject_Call", types.uintp(*[types.uintp] * 3))
_py_decref = types.ExternalFunction("Py_DecRef", types.void(types.uintp))
# Without the dispatch to other libraries' arrays, which takes as long as a small product.
_DOT = getattr(np.dot, "_implementation", np.dot)


class Inverse(NamedTuple):
    """Pseudo-inverse of a square matrix; its call of LAPACK overwrites ``result``."""

    given: np.ndarray  # (m, m), C order
    result: np.ndarray  # (m, m), Fortran order
    left: np.ndarray  # (m, m), singular vectors
    values: np.ndarray  # (m,)
    right: np.ndarray  # (m, m)
    rank: np.ndarray  # (1,)
    failed: np.ndarray  # (1,)
    decomposition: np.ndarray  # addresses of the arguments
    product: np.ndarray


class Space(NamedTuple):
    """Matrices and vectors of operational-space control, as robosuite has them."""

    mass: np.ndarray  # (n, n), Fortran order
    jacobian: np.ndarray  # (6, n)
    jacobian_position: np.ndarray  # (3, n)
    jacobian_rotation: np.ndarray  # (3, n)
    inverse_mass: np.ndarray  # (n, n), Fortran order
    nullspace: np.ndarray  # (n, n)
    moved: np.ndarray  # (n, n)
    failed: np.ndarray  # (1,)
    factors: np.ndarray  # addresses of the arguments
    inversion: np.ndarray
    products: np.ndarray  # (9, 13), addresses of the arguments of each
    full: Inverse
    position: Inverse
    rotation: Inverse
    acceleration: np.ndarray  # (n,), towards the pose at rest
    rest: np.ndarray  # (n,), torques in the null space
    to_pose: np.ndarray  # addresses of the arguments of :func:`move`
    to_rest: np.ndarray


class Arguments:
    """Makes arguments of the routines, and keeps alive what they refer to."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def _of(self, *values: Any) -> np.ndarray:
        """Addresses of arrays, letters, whole numbers and real numbers."""
        arrays = []
        for value in values:
            if isinstance(value, str):
                value = np.array([ord(value)], dtype=np.uint8)
            elif isinstance(value, int):
                value = np.array([value], dtype=np.int32)
            elif isinstance(value, float):
                value = np.array([value])
            arrays.append(value)
        self.kept += arrays
        return np.array([array.ctypes.data for array in arrays], dtype=np.uintp)

    def product(self, first: np.ndarray, second: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Arguments of ``dgemm``, as numba calls it for ``np.dot`` with a result in C order."""

        def matrix(array: np.ndarray) -> tuple[str, int]:
            in_c = array.flags.c_contiguous
            return ("n", array.shape[1]) if in_c else ("t", array.shape[0])

        (rows, inner), (_, columns) = first.shape, second.shape
        (turn1, lead1), (turn2, lead2) = matrix(first), matrix(second)
        sizes = (columns, rows, inner, 1.0)
        return self._of(turn2, turn1, *sizes, second, lead2, first, lead1, 0.0, out, out.shape[1])

    def move(self, matrix: np.ndarray, vector: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Arguments of ``dgemv``, as numba calls it for ``np.dot`` with a Fortran-order matrix."""
        assert matrix.flags.f_contiguous
        rows, columns = matrix.shape
        return self._of("n", rows, columns, 1.0, matrix, rows, vector, 1, 0.0, out, 1)

    def inverse(self, given: np.ndarray) -> Inverse:
        """Arguments and buffers of a pseudo-inverse, as numba has them for ``np.linalg.pinv``."""
        m = len(given)
        left, right = np.zeros((m, m)), np.zeros((m, m))
        result, values = np.zeros((m, m), order="F"), np.zeros(m)
        rank, failed = (np.zeros(1, dtype=np.int32) for _ in range(2))
        integers = np.zeros(8 * m, dtype=np.int32)
        head = ("S", m, m, result, m, values, left, m, right, m)
        size = np.zeros(1)
        _call("dgesdd", self._of(*head, size, -1, integers, failed))
        work = np.zeros(int(size[0]))
        return Inverse(
            given, result, left, values, right, rank, failed,
            self._of(*head, work, len(work), integers, failed),
            self._of("C", "C", m, m, rank, 1.0, right, m, left, m, 0.0, result, m),
        )  # fmt: skip

    def space(
        self, mass: np.ndarray, full: np.ndarray, position: np.ndarray, rotation: np.ndarray
    ) -> Space:
        """Arguments and buffers of :func:`invert_space`, and for the torques in the null space.

        Args:
            mass: (n, n), Fortran order.
            full: Jacobian, (6, n), C order.
            position: its part of the position, (3, n), C order.
            rotation: its part of the rotation, (3, n), C order.
        """
        n = len(mass)
        inverse_mass = np.zeros((n, n), order="F")
        pivots, failed = np.zeros(n, dtype=np.int32), np.zeros(1, dtype=np.int32)
        size = np.zeros(1)
        _call("dgetri", self._of(n, inverse_mass, n, pivots, size, -1, failed))
        work = np.zeros(int(size[0]))
        products = []

        def square(jacobian: np.ndarray) -> Inverse:
            rows = len(jacobian)
            between, given = np.zeros((rows, n)), np.zeros((rows, rows))
            products.append(self.product(jacobian, inverse_mass, between))
            products.append(self.product(between, jacobian.T, given))
            return self.inverse(given)

        inverses = square(full), square(position), square(rotation)
        between, back, moved = np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, n))
        products.append(self.product(inverse_mass, full.T, between))
        products.append(self.product(between, inverses[0].result, back))
        products.append(self.product(back, full, moved))
        nullspace, acceleration, pose, rest = np.zeros((n, n)), *np.zeros((3, n))
        return Space(
            mass=mass,
            jacobian=full,
            jacobian_position=position,
            jacobian_rotation=rotation,
            inverse_mass=inverse_mass,
            nullspace=nullspace,
            moved=moved,
            failed=failed,
            factors=self._of(n, n, inverse_mass, n, pivots, failed),
            inversion=self._of(n, inverse_mass, n, pivots, work, len(work), failed),
            products=np.array(products),
            full=inverses[0],
            position=inverses[1],
            rotation=inverses[2],
            acceleration=acceleration,
            rest=rest,
            to_pose=self.move(mass, acceleration, pose),
            to_rest=self.move(nullspace.T, pose, rest),
        )

    def numpys_product(self, matrix: np.ndarray, vector: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Arguments of :func:`numpys_product`, as numpy calls BLAS for ``np.dot(..., out=out)``.

        The last ones are for a numpy whose BLAS cannot be called.
        """
        order, lead = (101, 1) if matrix.flags.c_contiguous else (102, 0)
        call = (matrix, vector, out)
        self.kept += [call]
        data = [array.ctypes.data for array in call]
        numbers = [order, *matrix.shape, matrix.shape[lead], *data, id(_DOT), id(call)]
        return np.array(numbers, dtype=np.int64)


def _call(name: str, addresses: np.ndarray) -> None:
    """Calls a routine of scipy from Python."""
    function = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(addresses))(_address(name))
    function(*addresses.tolist())


@cached_njit
def _multiply(a: np.ndarray) -> None:
    _dgemm(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10], a[11], a[12])


@cached_njit
def move(a: np.ndarray) -> None:
    """``np.dot(matrix, vector)`` of numba.

    Args:
        a: of :meth:`Arguments.move`.
    """
    _dgemv(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10])


@cached_njit
def numpys_product(direct: bool, a: np.ndarray) -> None:
    """``np.dot(matrix, vector, out=out)`` of numpy: its BLAS is not numba's, and rounds otherwise.

    Args:
        direct: whether numpy's BLAS can be called; otherwise Python calls ``np.dot``.
        a: of :meth:`Arguments.numpys_product`.
    """
    if direct:
        _numpys_dgemv(a[0], 111, a[1], a[2], 1.0, a[4], a[3], a[5], 1, 0.0, a[6], 1)
    else:
        _py_decref(_py_call(a[7], a[8], 0))


@cached_njit
def _copy_finite(matrix: np.ndarray, copy: np.ndarray) -> None:
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            copy[i, j] = matrix[i, j]
            if not np.isfinite(matrix[i, j]):
                raise np.linalg.LinAlgError("Array must not contain infs or NaNs.")


@cached_njit
def _invert(inverse: Inverse) -> None:
    # As np.linalg.pinv.
    _copy_finite(inverse.given, inverse.result)
    a = inverse.decomposition
    _dgesdd(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10], a[11], a[12], a[13])
    if inverse.failed[0] != 0:
        raise ValueError("Internal algorithm failed to converge.")
    values = inverse.values
    cut, rank = values[0] * 1e-15, 0
    for k in range(len(values)):
        if values[k] > cut:
            values[k] = 1.0 / values[k]
            rank = k
    inverse.rank[0] = rank + 1
    for i in range(len(values)):
        for j in range(rank + 1):
            inverse.right[i, j] = inverse.right[i, j] * values[j]
    _multiply(inverse.product)


@cached_njit
def invert_space(space: Space) -> None:
    """As ``opspace_matrices`` of robosuite; the inverses are results of the space's parts.

    Args:
        space: of :meth:`Arguments.space`; its mass and the Jacobians are given.
    """
    _copy_finite(space.mass, space.inverse_mass)
    a = space.factors
    _dgetrf(a[0], a[1], a[2], a[3], a[4], a[5])
    if space.failed[0] == 0:
        a = space.inversion
        _dgetri(a[0], a[1], a[2], a[3], a[4], a[5], a[6])
    if space.failed[0] != 0:
        raise np.linalg.LinAlgError("Matrix is singular to machine precision.")
    products = space.products
    for i in range(6):
        _multiply(products[i])
    _invert(space.full)
    _invert(space.position)
    _invert(space.rotation)
    for i in range(6, 9):
        _multiply(products[i])
    for i in range(len(space.mass)):
        for j in range(len(space.mass)):
            space.nullspace[i, j] = (1.0 if i == j else 0.0) - space.moved[i, j]
