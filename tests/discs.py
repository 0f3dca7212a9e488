"""A solver of robots with discs that shares nothing with the library: its tendons run straight from hole to hole."""

import numpy as np

PIECES = 4  # of a gap
STEP = 1e-6  # of the differences in Newton's Jacobian


def rotations(w: np.ndarray) -> np.ndarray:
    """exp(hat(w)) (B, 3, 3) of vectors (B, 3), by Rodrigues."""
    angle = np.sqrt((w * w).sum(-1))[:, None, None]
    hat = np.zeros((len(w), 3, 3))
    hat[:, [2, 0, 1], [1, 2, 0]], hat[:, [1, 2, 0], [2, 0, 1]] = w, -w
    return np.eye(3) + np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * hat @ hat


def disc_by_disc(
    K_se: np.ndarray,
    K_bt: np.ndarray,
    holes: np.ndarray,
    discs: np.ndarray,
    tension: np.ndarray,
    force: np.ndarray,
    weight: np.ndarray,
    guess: tuple[np.ndarray, np.ndarray],
    mu: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (D, 3) m of the sections at the discs (D,) m, the last at the tip, and the moment (3,) N m at the base.

    holes: (D + 1, T, 2) m, in the base plate and in every disc. force: (3,) N, dead, at the tip; weight: (3,) N/m. guess: where the
    holes are, (D + 1, T, 3) m, and the moment at the base. mu: friction in the holes, the base plate's included.
    In a gap the backbone carries what the section carries less the tendons' pull along the lines through their holes. Unknown are
    those lines and the moment at the base; Newton with differences, all of them marched together, by the Lie-group scheme of
    order 4 (Munthe-Kaas).
    """
    nodes, T = np.concatenate([[0.0], discs]), holes.shape[1]
    L, D, gaps, r = nodes[-1], len(discs), np.diff(nodes)[:, None, None], np.pad(holes, ((0, 0), (0, 0), (0, 1)))
    K_se, K_bt = np.linalg.inv(K_se), np.linalg.inv(K_bt)
    unit = max(float(np.abs(guess[1]).max()), 1e-3)

    def march(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is wrong (B, n) with x (B, n) = [moment at the base, lines], and the sections' positions (B, D, 3)."""
        B = len(x)
        m, lines = unit * x[:, :3], x[:, 3:].reshape(B, D, T, 3)
        p, R, tau, before = np.zeros((B, 3)), np.tile(np.eye(3), (B, 1, 1)), np.tile(tension, (B, 1)), np.array([0.0, 0.0, 1.0])
        at, places = [p[:, None] + np.einsum("bij,tj->bti", R, r[0])], []
        for i in range(D):
            d = lines[:, i] / np.linalg.norm(lines[:, i], axis=-1, keepdims=True)
            tau = tau * np.exp(-mu * np.arccos(np.clip((d * before).sum(-1), -1, 1)))
            before, start, pull, h = d, at[-1], tau[..., None] * d, (nodes[i + 1] - nodes[i]) / PIECES

            def rates(s: float, p: np.ndarray, R: np.ndarray, m: np.ndarray, start=start, pull=pull) -> tuple[np.ndarray, ...]:
                n = force + weight * (L - s) + 0 * p
                own = m - np.cross(start - p[:, None], pull).sum(1)
                v = np.array([0.0, 0.0, 1.0]) + np.einsum("ij,bkj,bk->bi", K_se, R, n - pull.sum(1))
                dp = np.einsum("bij,bj->bi", R, v)
                return dp, np.einsum("ij,bkj,bk->bi", K_bt, R, own), -np.cross(dp, n)

            for k in range(PIECES):
                s, found, w, reach = nodes[i] + k * h, [], np.zeros((B, 3)), (0.0, 0.5, 0.5, 1.0)
                for share in reach:
                    a, u, b = found[-1] if found else (0 * p, 0 * p, 0 * p)
                    w = share * h * u
                    dp, own, dm = rates(s + share * h, p + share * h * a, R @ rotations(w), m + share * h * b)
                    turning = np.cross(w, own)
                    found.append((dp, own + 0.5 * turning + np.cross(w, turning) / 12, dm))
                p, w, m = (y + h / 6 * (k1 + 2 * (k2 + k3) + k4) for y, k1, k2, k3, k4 in zip((p, 0 * p, m), *found, strict=True))
                R = R @ rotations(w)
            at.append(p[:, None] + np.einsum("bij,tj->bti", R, r[i + 1]))
            places.append(p)
        off = lines - np.diff(np.stack(at, 1), axis=1) / gaps
        return np.concatenate([m / unit, off.reshape(B, -1)], -1), np.stack(places, 1)

    x = np.concatenate([guess[1] / unit, (np.diff(guess[0], axis=0) / gaps).ravel()])
    for _ in range(20):
        off, places = march(np.concatenate([x[None], x + STEP * np.eye(len(x))]))
        if np.abs(off[0]).max() < 1e-11:
            return places[0], unit * x[:3]
        x = x - np.linalg.solve((off[1:] - off[0]).T / STEP, off[0])
    raise AssertionError("the disc-by-disc solver has not settled")
