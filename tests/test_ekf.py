"""The filter's algebra against the textbook's, written out here."""

from dataclasses import replace

import torch

from torchrod.estimation import filter as ekf

B, Z, N = 3, 20, 8


def problem():
    torch.manual_seed(0)
    H, r, w = torch.randn(B, Z, N), torch.randn(B, Z), torch.rand(B, Z) + 0.5
    root = torch.randn(B, N, N)
    return H, r, w, root @ root.mT + torch.eye(N)


def no_prior(x):
    return x.new_zeros(N), x.new_zeros(N)


def test_information_form_is_the_papers_recursion():
    """(4) as printed, with the innovation z - h(x): K = S H^T (H S H^T + R)^-1, Sigma+ = (I - K H) S."""
    H, r, w, Sigma = problem()
    Q = torch.rand(N)
    S = Sigma + torch.diag(Q)
    K = S @ H.mT @ torch.linalg.inv(H @ S @ H.mT + torch.diag_embed(1 / w))
    x = torch.zeros(B, N)
    A, g = ekf.information(H, r, w, x, *no_prior(x))
    step, Sigma_next, _ = ekf.update(ekf.predict(Sigma, Q), A, g)
    assert torch.allclose(step, (K @ r.unsqueeze(-1)).squeeze(-1), atol=1e-10)
    assert torch.allclose(Sigma_next, (torch.eye(N) - K @ H) @ S, atol=1e-10)


def test_on_a_linear_model_it_is_batch_least_squares():
    """One update without Q from a prior N(x0, Sigma) is the weighted least squares solution, mean and covariance."""
    H, z, w, Sigma = problem()
    x0 = torch.randn(B, N)
    A, g = ekf.information(H, z - (H @ x0.unsqueeze(-1)).squeeze(-1), w, x0, *no_prior(x0))
    step, covariance, _ = ekf.update(Sigma, A, g)
    for b in range(B):
        rows = torch.cat([H[b] * w[b].sqrt()[:, None], torch.linalg.inv(torch.linalg.cholesky(Sigma[b]))])
        right = torch.cat([z[b] * w[b].sqrt(), torch.linalg.inv(torch.linalg.cholesky(Sigma[b])) @ x0[b]])
        mean = torch.linalg.lstsq(rows, right[:, None]).solution[:, 0]
        assert torch.allclose((x0 + step)[b], mean, atol=1e-10)
        assert torch.allclose(covariance[b], torch.linalg.inv(rows.T @ rows), atol=1e-10)


def test_a_prior_is_one_more_measurement():
    H, r, w, _ = problem()
    x, mean, precision = torch.randn(B, N), torch.randn(N), torch.rand(N) + 0.1
    A, g = ekf.information(H, r, w, x, mean, precision)
    more_H = torch.cat([H, torch.eye(N).expand(B, N, N)], 1)
    more_r = torch.cat([r, mean - x], 1)
    again = ekf.information(more_H, more_r, torch.cat([w, precision.expand(B, N)], 1), x, *no_prior(x))
    assert torch.allclose(A, again[0])
    assert torch.allclose(g, again[1])


def test_posterior_counts_the_data_once_however_often_it_is_iterated():
    """The recursion's Sigma shrinks with every iteration on the same data; the posterior does not."""
    H, r, w, Sigma = problem()
    x = torch.zeros(B, N)
    A, g = ekf.information(H, r, w, x, *no_prior(x))
    once = ekf.update(Sigma, A, g)[1]
    twice = ekf.update(once, A, g)[1]
    assert (twice.diagonal(dim1=1, dim2=2) < 0.6 * ekf.inverse(A).diagonal(dim1=1, dim2=2)).all()
    assert torch.allclose(ekf.inverse(A), torch.linalg.inv(A), atol=1e-12)


def test_decrement_is_what_a_step_gains():
    H, r, w, _ = problem()
    x = torch.zeros(B, N)
    A, g = ekf.information(H, r, w, x, *no_prior(x))
    left = r - (H @ torch.linalg.solve(A, g.unsqueeze(-1))).squeeze(-1)
    assert torch.allclose(ekf.decrement(A, g), (w * r**2).sum(-1) - (w * left**2).sum(-1))


def test_a_bad_sample_is_nan_and_alone():
    _, _, _, Sigma = problem()
    bad = Sigma.clone()
    bad[1, 0, 0] = torch.nan
    b = torch.ones(B, N, 1)
    solved = ekf.solve_spd(bad, b)
    assert solved[1].isnan().all()
    assert torch.equal(solved[[0, 2]], ekf.solve_spd(Sigma, b)[[0, 2]])


def test_adapted_weights_return_to_the_truth():
    """R = sigma^2 (1 + promised / m) on what the m sensor rows say, not on the tip residual; with a cap of zero the true R."""
    H, r, w, Sigma = problem()
    w[:, 3] = 0.0
    groups, tip, Q, x = torch.arange(Z - 6) // 2, torch.zeros(Z), torch.rand(N), torch.randn(B, N)
    tip[-6:] = 1.0
    prior = torch.randn(N), torch.rand(N) + 0.1
    normal, limits = ekf.normal_equations(H, r, w, groups), ekf.Limits(step=torch.inf)
    assert normal.seen.tolist() == [Z - 7] * B
    promised = ekf.decrement(*ekf.information(H, r, w, x, *prior))
    cap = torch.tensor([torch.inf, 0.5 * float(promised[1]) / (Z - 7), 0.0])
    at = replace(ekf.Iterate.start(x, Sigma, 0.0), cap=cap)
    after = ekf.advance(at, normal, Sigma, prior, Q, limits)
    inflated = promised / (Z - 7) * torch.tensor([1.0, 0.5, 0.0])
    adapted = torch.where(tip > 0, w, w / (1 + inflated).unsqueeze(-1))
    A, g = ekf.information(H, r, adapted, x, *prior)
    step, Sigma_next, _ = ekf.update(ekf.predict(Sigma, Q), A, g)
    assert torch.allclose(after.x, x + step, atol=1e-10)
    assert torch.allclose(after.Sigma, Sigma_next, atol=1e-10)
    settled = ekf.advance(at, normal, Sigma, prior, Q, limits._replace(settled=torch.inf))
    assert torch.allclose(settled.cap, 0.1 * inflated)
    moving = ekf.advance(at, normal, Sigma, prior, Q, limits._replace(settled=0.0))
    assert torch.equal(moving.cap, cap)


def conditioned(H, r, w):
    """Weighted least squares of all rows but the last six, which hold exactly: by the whole system with multipliers."""
    steps, covariances = [], []
    for b in range(len(H)):
        C, c, W = H[b, -6:], r[b, -6:], w[b, :-6]
        A, g = H[b, :-6].T @ (W[:, None] * H[b, :-6]), H[b, :-6].T @ (W * r[b, :-6])
        whole = torch.cat([torch.cat([A, C.T], 1), torch.cat([C, torch.zeros(6, 6)], 1)])
        inverse = torch.linalg.inv(whole)
        steps.append((inverse @ torch.cat([g, c]))[:N])
        covariances.append(inverse[:N, :N])
    return torch.stack(steps), torch.stack(covariances)


def test_the_tip_condition_holds_to_first_order():
    """Step and covariance under c = 0 against the system with multipliers, and against ever larger weights on c."""
    H, r, w, _ = problem()
    x = torch.zeros(B, N)
    normal = ekf.normal_equations(H, r, w, torch.arange(Z - 6) // 2)
    A, g, _ = normal.readings.whole(x, *no_prior(x))
    assert normal.tip is not None
    step, covariance = normal.tip.solve(A, g)
    expected = conditioned(H, r, w)
    assert torch.allclose(step, expected[0], atol=1e-9)
    assert torch.allclose(covariance, expected[1], atol=1e-9)
    assert torch.allclose((H[:, -6:] @ step.unsqueeze(-1)).squeeze(-1), r[:, -6:], atol=1e-9)
    stiff = torch.cat([w[:, :-6], torch.full((B, 6), 1e9)], -1)
    assert torch.allclose(
        step, ekf.update(1e12 * torch.eye(N).repeat(B, 1, 1), *ekf.information(H, r, stiff, x, *no_prior(x)))[0], atol=1e-6
    )


def test_a_tip_condition_without_a_solution_is_nan_and_alone():
    H, r, w, _ = problem()
    H[1, -6:, -1] = 0.0
    tip = ekf.normal_equations(H, r, w, torch.arange(Z - 6) // 2).tip
    assert tip is not None
    assert torch.isnan(tip.d[1]).all() and torch.isnan(tip.T[1]).all()
    assert torch.isfinite(tip.d[[0, 2]]).all() and torch.isfinite(tip.T[[0, 2]]).all()


def test_an_exact_iteration_damps_and_adapts_under_the_tip_condition():
    """`advance` with exact: the readings' weights adapted, Sigma_bar as damping, c = 0, from a c that is not zero."""
    H, r, w, Sigma = problem()
    Q, x, prior = torch.rand(N), torch.randn(B, N), (torch.randn(N), torch.rand(N) + 0.1)
    normal = ekf.normal_equations(H, r, w, torch.arange(Z - 6) // 2)
    at = replace(ekf.Iterate.start(x, Sigma, 0.0), cap=torch.tensor([torch.inf, 0.3, 0.0]))
    after = ekf.advance(at, normal, Sigma, prior, Q, ekf.Limits(step=torch.inf, exact=True))
    A, g, _ = normal.readings.whole(x, *prior)
    assert normal.tip is not None
    promised = ekf.square(A, normal.tip.solve(A, g)[0])
    inflated = torch.minimum(promised / (Z - 6), at.cap)
    readings = torch.cat([H[:, :-6], torch.eye(N).repeat(B, 2, 1), H[:, -6:]], 1)
    root = torch.linalg.cholesky(torch.linalg.inv(Sigma + torch.diag(Q)))
    readings[:, Z - 6 + N : -6] = root.mT
    right = torch.cat([r[:, :-6], prior[0] - x, torch.zeros(B, N), r[:, -6:]], 1)
    weights = torch.cat([w[:, :-6] / (1 + inflated).unsqueeze(-1), prior[1].expand(B, N), torch.ones(B, N + 6)], 1)
    step, covariance = conditioned(readings, right, weights)
    assert torch.allclose(after.x, x + step, atol=1e-9)
    assert torch.allclose(after.Sigma, covariance, atol=1e-9)


def test_a_step_that_turns_back_goes_half_as_far():
    came, step = torch.tensor([[0.6, 0.1, 0.0]]), torch.tensor([[-1.2, 0.3, 0.0]])
    reach = torch.tensor([0.8])
    assert torch.allclose(ekf.reached(step, came, reach, 0.6), torch.tensor([0.4]))
    assert torch.allclose(ekf.reached(-step, came, reach, 0.6), torch.tensor([0.96]))
    assert torch.allclose(ekf.reached(-step, came, torch.tensor([0.95]), 0.6), torch.tensor([1.0]))
    assert torch.allclose(ekf.reached(torch.tensor([[-0.1, 0.3, torch.nan]]), came, reach, 0.6), torch.tensor([0.96])), (
        "the largest says"
    )
    assert torch.allclose(ekf.reached(step, 0.01 * came, reach, 0.6), torch.tensor([0.96])), "a step too small to be undone"
