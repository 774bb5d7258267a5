"""What a kernel of the regression knows when it is compiled."""

from __future__ import annotations

from dataclasses import dataclass

PATCH = 4  # the solve runs in patches of 4 x 4 numbers that stay in registers
LANES = 8  # numbers that a vector holds, in which products are summed up


@dataclass(frozen=True)
class Layout:
    """Sizes of a voxel's regression (Eq. 6), passed to kernels as one compile-time argument.

    The Gram matrix holds `size` rows of P^T P, with the targets' rows Y^T P below; padding is zero.
    """

    rank: int  # l, eigenpairs of the position encoding
    channels: int  # c, of the targets
    centered: bool = (
        False  # regress about the mean of the targets, which is one more row of a latent
    )
    derivatives: bool = False  # samples carry normals too (Eq. 16)...
    some_normals: bool = False  # ...but only those on the surface
    information: bool = False  # keep sums and solve when fusing, instead of fusing latents (Eq. 19)

    @property
    def size(self) -> int:
        """Rows of P^T P: the rank, rounded up to whole patches."""
        return _whole_patches(self.rank)

    @property
    def rows(self) -> int:
        """Rows of the Gram matrix: P^T P, then the targets and, if centred, the ones."""
        return self.size + _whole_patches(self.channels + self.centered)

    @property
    def vectors(self) -> int:
        """Vectors that hold a row of P, then the targets and, if centred, the one."""
        return -(-self.rows // LANES)

    @property
    def feature_vectors(self) -> int:
        """Vectors, the first of them, that hold f_posi; the last may hold targets too."""
        return -(-self.size // LANES)

    @property
    def latent_rows(self) -> int:
        """Rows of a latent: F, then the prior mean if centred."""
        return self.rank + self.centered

    @property
    def sums(self) -> int:
        """Numbers that a regression sums up for a voxel, as `gram.keep_sums` lays them out."""
        lower_half = self.size * (self.size + 1) // 2
        return lower_half + self.size * (self.channels + self.centered) + self.channels


def _whole_patches(n: int) -> int:
    return -(-n // PATCH) * PATCH
