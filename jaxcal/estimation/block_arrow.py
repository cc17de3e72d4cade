"""Block-arrow normal equations: a block band along a chain, with a dense border of shared parameters.

    H = [ A   C ]     A: K chain blocks of size B, each coupled to its w - 1 followers (block band)
        [ C'  S ]     C: chain times shared,   S: shared times shared (P x P)

A structured Cholesky factorisation, linear in K, solves with H; its Schur complement S - C' A^-1 C is the information
matrix of the shared parameters.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int


class BlockArrow(eqx.Module):
    """Normal equations of a least-squares problem, 0.5 x' H x + g' x + cost.

    `band[k, d]` (K, w, B, B) is the block of H at rows of chain block k + d and columns of chain block k (its upper
    half follows by symmetry); `border` (K, B, P); `corner` (P, P); `gradient_chain` (K, B); `gradient_shared` (P,);
    `cost` half the sum of squares.
    """

    band: Float[Array, "K w B B"]
    border: Float[Array, "K B P"]
    corner: Float[Array, "P P"]
    gradient_chain: Float[Array, "K B"]
    gradient_shared: Float[Array, " P"]
    cost: Float[Array, ""]

    def hold(self, free_chain: Bool[Array, "K B"], free_shared: Bool[Array, " P"]) -> "BlockArrow":
        """The same equations with the other parameters held: their rows become those of the identity."""
        chain = free_chain.astype(self.band.dtype)
        shared = free_shared.astype(self.band.dtype)
        width = self.band.shape[1]
        followers = jnp.stack([jnp.roll(chain, -d, axis=0) for d in range(width)], axis=1)
        band = self.band * followers[:, :, :, None] * chain[:, None, None, :]
        eye = jnp.eye(chain.shape[1], dtype=band.dtype)
        band = band.at[:, 0].add(eye * (1.0 - chain)[:, None, :])
        corner = self.corner * shared[:, None] * shared[None, :] + jnp.diag(1.0 - shared)
        return BlockArrow(
            band=band,
            border=self.border * chain[:, :, None] * shared,
            corner=corner,
            gradient_chain=self.gradient_chain * chain,
            gradient_shared=self.gradient_shared * shared,
            cost=self.cost,
        )

    def diagonal(self) -> tuple[Float[Array, "K B"], Float[Array, " P"]]:
        """The diagonal of H, chain and shared."""
        return jnp.diagonal(self.band[:, 0], axis1=-2, axis2=-1), jnp.diagonal(self.corner)

    def mv(
        self, chain: Float[Array, "K B"], shared: Float[Array, " P"]
    ) -> tuple[Float[Array, "K B"], Float[Array, " P"]]:
        """H times a vector (chain part, shared part)."""
        out = jnp.einsum("kbc,kc->kb", self.band[:, 0], chain) + self.border @ shared
        num_blocks = chain.shape[0]
        for d in range(1, self.band.shape[1]):
            below = self.band[: num_blocks - d, d]
            out = out.at[d:].add(jnp.einsum("kbc,kc->kb", below, chain[: num_blocks - d]))
            out = out.at[: num_blocks - d].add(jnp.einsum("kbc,kb->kc", below, chain[d:]))
        return out, jnp.einsum("kbp,kb->p", self.border, chain) + self.corner @ shared

    def dense(self) -> Float[Array, "N N"]:
        """H as one dense matrix, chain first; for tests and small problems."""
        num_blocks, size = self.gradient_chain.shape
        identity = jnp.eye(num_blocks * size + self.corner.shape[0])
        split = num_blocks * size

        def column(unit: Array) -> Array:
            chain, shared = self.mv(unit[:split].reshape(num_blocks, size), unit[split:])
            return jnp.concatenate([chain.ravel(), shared])

        return jax.vmap(column, out_axes=1)(identity)


class BlockArrowFactor(eqx.Module):
    """Cholesky factor of a block-arrow matrix, in superblocks of w - 1 chain blocks (block tridiagonal).

    Per superblock: `lower` its Cholesky factor; `below` the factor's block under it; `border` the factor's rows of the
    border; `schur_lower` is the Cholesky factor of the Schur complement on the shared parameters.
    """

    lower: Float[Array, "J n n"]
    below: Float[Array, "J n n"]
    border: Float[Array, "J n P"]
    schur: Float[Array, "P P"]
    schur_lower: Float[Array, "P P"]
    block_size: int = eqx.field(static=True)
    num_blocks: int = eqx.field(static=True)
    coupled: bool = eqx.field(static=True)

    def solve(
        self, chain: Float[Array, "K B"], shared: Float[Array, " P"]
    ) -> tuple[Float[Array, "K B"], Float[Array, " P"]]:
        """Solve H x = b for one right-hand side (chain part, shared part)."""
        rhs = _to_superblocks(chain, self.lower.shape[1] // self.block_size)

        if self.coupled:

            def forward(carry: Array, factor: tuple[Array, Array, Array]) -> tuple[Array, Array]:
                lower, below, b = factor
                z = solve_triangular(lower, b - carry, lower=True)
                return below @ z, z

            _, z = jax.lax.scan(forward, jnp.zeros_like(rhs[0]), (self.lower, self.below, rhs))
        else:
            z = jax.vmap(lambda lower, b: solve_triangular(lower, b, lower=True))(self.lower, rhs)

        x_shared = cho_solve((self.schur_lower, True), shared - jnp.einsum("jnp,jn->p", self.border, z))
        z = z - self.border @ x_shared

        if self.coupled:

            def backward(carry: Array, factor: tuple[Array, Array, Array]) -> tuple[Array, Array]:
                lower, below, b = factor
                x = solve_triangular(lower, b - below.T @ carry, lower=True, trans=1)
                return x, x

            _, x = jax.lax.scan(backward, jnp.zeros_like(rhs[0]), (self.lower, self.below, z), reverse=True)
        else:
            x = jax.vmap(lambda lower, b: solve_triangular(lower, b, lower=True, trans=1))(self.lower, z)
        return x.reshape(-1, self.block_size)[: self.num_blocks], x_shared

    def shared_covariance(self) -> Float[Array, "P P"]:
        """Covariance of the shared parameters with the chain marginalised: the inverse Schur complement."""
        return cho_solve((self.schur_lower, True), jnp.eye(self.schur.shape[0]))

    def chain_covariance(self) -> Float[Array, "K B B"]:
        """Marginal covariance of every chain block, shared parameters marginalised too.

        Backward recursion over the factor's sparsity (Takahashi et al. 1973; Erisman & Tinney 1975).
        """
        n = self.lower.shape[1]
        eye = jnp.eye(n)
        shared = self.shared_covariance()

        def backward(
            carry: tuple[Array, Array], factor: tuple[Array, Array, Array]
        ) -> tuple[tuple[Array, Array], Array]:
            # With L the full factor and Z its inverse product, rows of superblock j:
            # Z[j, later] = -L_jj^-T (L_later,j)' Z[later, later]
            later_cov, later_cross = carry  # Z[j+1, j+1] (n, n), Z[j+1, shared] (n, P)
            lower, below, border = factor
            inverse = solve_triangular(lower, eye, lower=True)
            cross_next = -inverse.T @ (below.T @ later_cov + border @ later_cross.T)
            cross_shared = -inverse.T @ (below.T @ later_cross + border @ shared)
            own = inverse.T @ inverse - inverse.T @ (below.T @ cross_next.T + border @ cross_shared.T)
            own = 0.5 * (own + own.T)
            return (own, cross_shared), own

        start = (jnp.zeros((n, n)), jnp.zeros((n, shared.shape[0])))
        _, blocks = jax.lax.scan(backward, start, (self.lower, self.below, self.border), reverse=True)
        per = n // self.block_size
        blocks = blocks.reshape(-1, per, self.block_size, per, self.block_size)
        diagonal = jnp.stack([blocks[:, a, :, a, :] for a in range(per)], axis=1)
        return diagonal.reshape(-1, self.block_size, self.block_size)[: self.num_blocks]


def factorise(
    equations: BlockArrow, damping_chain: Float[Array, "K B"], damping_shared: Float[Array, " P"]
) -> BlockArrowFactor:
    """Cholesky factor of H plus a diagonal. NaN wherever the damped matrix is not positive definite."""
    num_blocks, width, size, _ = equations.band.shape
    per = max(width - 1, 1)
    num_super = -(-num_blocks // per)
    diagonal, below = _superblock_matrices(equations.band, damping_chain, per, num_super)
    border = _to_superblocks(equations.border, per)
    corner = equations.corner + jnp.diag(damping_shared)

    if width == 1:
        lower = jnp.linalg.cholesky(diagonal)
        factor_border = jax.vmap(lambda l, c: solve_triangular(l, c, lower=True))(lower, border)
    else:

        def step(carry: tuple[Array, Array], block: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple]:
            subtract, subtract_border = carry
            own, under, c = block
            lower = jnp.linalg.cholesky(own - subtract)
            right = solve_triangular(lower, jnp.concatenate([under.T, c - subtract_border], axis=1), lower=True)
            under, c = right[:, : own.shape[0]].T, right[:, own.shape[0] :]
            return (under @ under.T, under @ c), (lower, under, c)

        start = (jnp.zeros_like(diagonal[0]), jnp.zeros_like(border[0]))
        _, (lower, below, factor_border) = jax.lax.scan(step, start, (diagonal, below, border))

    schur = corner - jnp.einsum("jnp,jnq->pq", factor_border, factor_border)
    return BlockArrowFactor(
        lower=lower,
        below=below,
        border=factor_border,
        schur=schur,
        schur_lower=jnp.linalg.cholesky(schur),
        block_size=size,
        num_blocks=num_blocks,
        coupled=width > 1,
    )


def gathered_band(band: Float[Array, "K w B B"], per: int) -> Float[Array, "M 2 n n"]:
    """The same band in blocks of `per` chain blocks each, w - 1 at least, which couple to their followers alone. Chain
    blocks that are missing in the last one are rows of the identity."""
    count = -(-band.shape[0] // per)
    return jnp.stack(_superblock_matrices(band, jnp.zeros(band.shape[:1] + band.shape[2:3]), per, count), axis=1)


def gathered_chain(rows: Float[Array, "K B *rest"], per: int) -> Float[Array, "M n *rest"]:
    """As `gathered_band` for gradients and border rows; what is missing is zero."""
    return _to_superblocks(rows, per)


def _to_superblocks(rows: Float[Array, "K B *rest"], per: int) -> Float[Array, "J n *rest"]:
    num_blocks, size, *rest = rows.shape
    num_super = -(-num_blocks // per)
    padded = jnp.pad(rows, [(0, num_super * per - num_blocks), (0, 0)] + [(0, 0)] * len(rest))
    return padded.reshape(num_super, per * size, *rest)


def _superblock_matrices(
    band: Float[Array, "K w B B"], damping: Float[Array, "K B"], per: int, num_super: int
) -> tuple[Float[Array, "J n n"], Float[Array, "J n n"]]:
    """Diagonal superblocks, and the blocks below them; missing chain blocks at the end are identities."""
    num_blocks, width, size, _ = band.shape
    missing = num_super * per - num_blocks
    eye = jnp.eye(size)
    band = band.at[:, 0].add(eye * damping[:, None, :])
    padding = jnp.zeros((missing, width, size, size)).at[:, 0].set(eye)
    band = jnp.concatenate([band, padding]).reshape(num_super, per, width, size, size)
    zero = jnp.zeros((num_super, size, size))

    def own(a: int, b: int) -> Array:
        if a >= b:
            return band[:, b, a - b] if a - b < width else zero
        return own(b, a).swapaxes(-1, -2)

    def under(a: int, b: int) -> Array:
        distance = per + a - b
        return band[:, b, distance] if distance < width else zero

    def assemble(block: Callable[[int, int], Array]) -> Array:
        return jnp.concatenate(
            [jnp.concatenate([block(a, b) for b in range(per)], axis=2) for a in range(per)],
            axis=1,
        )

    return assemble(own), assemble(under)


def band_from_windows(windows: Float[Array, "I w B w B"]) -> Float[Array, "K w B B"]:
    """Sum per-interval Hessians over the chain: interval i couples chain blocks i .. i + w - 1; K = I + w - 1."""
    intervals, width = windows.shape[:2]
    blocks = intervals + width - 1
    diagonals = [
        sum_along_chain([(a, windows[:, a + d, :, a, :]) for a in range(width - d)], blocks) for d in range(width)
    ]
    return jnp.stack(diagonals, axis=1)


def chain_from_windows(windows: Float[Array, "I w B *rest"], blocks: int | None = None) -> Float[Array, "K B *rest"]:
    """Sum per-interval gradients or border rows over the chain of K blocks, by default K = I + w - 1."""
    intervals, width = windows.shape[:2]
    return sum_along_chain([(a, windows[:, a]) for a in range(width)], blocks or intervals + width - 1)


def scattered_band(start: Int[Array, " M"], windows: Float[Array, "M w B w B"], blocks: int) -> Float[Array, "K w B B"]:
    """As `band_from_windows` for measurements whose windows start at chain blocks `start`, several at the same or none.

    Block by block: scattering whole windows first takes five times as long.
    """
    _, width, size = windows.shape[:3]
    diagonal, first = np.array([(d, a) for d in range(width) for a in range(width - d)]).T
    parts = windows[:, first + diagonal, :, first, :]  # (blocks of a window, M, B, B)
    band = jnp.zeros((blocks, width, size, size))
    return band.at[start + first[:, None], diagonal[:, None]].add(parts)


def scattered_chain(
    start: Int[Array, " M"], windows: Float[Array, "M w B *rest"], blocks: int
) -> Float[Array, "K B *rest"]:
    """As `chain_from_windows` for measurements whose windows start at chain blocks `start`."""
    chain = jnp.zeros((blocks, *windows.shape[2:]))
    return chain.at[start[:, None] + np.arange(windows.shape[1])].add(windows)


def sum_along_chain(parts: Sequence[tuple[int, Float[Array, "I *rest"]]], blocks: int) -> Float[Array, "K *rest"]:
    """Sum of `parts`, each an offset and what it adds to the chain blocks from there on.

    In place, part by part: as a sum of padded arrays it is one loop, and a third faster, but jax 0.10.2 compiled that
    into wrong sums in every other row of one column (four parts of two IMUs, on the CPU; right without
    `xla_cpu_use_fusion_emitters`).
    """
    total = jnp.zeros((blocks, *parts[0][1].shape[1:]))
    for offset, part in parts:
        total = total.at[offset : offset + len(part)].add(part)
    return total
