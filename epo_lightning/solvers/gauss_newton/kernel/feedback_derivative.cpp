// The derivative of feedback equilibria of driving games, which are fixed points of the iteration in `feedback.cpp`; see
// `solvers/feedback/derivative.py`, which does the same in PyTorch for all energies.

#include "feedback.hpp"

#include <algorithm>

#include "feedback_games.hpp"

namespace EPO_LEVEL {
namespace {

using namespace lq;

/// The derivative at the solutions of W games.
template <int N>
class Derivative {
  public:
    Derivative(const Game& g, const Sizes<N>& size, double rho)
        : g_(g), size_(size), rho_(rho), value_size_(size.agents() * size.states() * size.width()),
          policies_(g.arena.take(g.K * size.controls() * size.width())), values_(g.arena.take(std::size_t(g.K) * value_size_)),
          value_bar_(g.arena.take(value_size_)), offsets_(g.arena.take(cells())), state_bar_(g.arena.take(size.states())),
          before_(g.arena.take(size.states())), states_bar_(g.arena.take((g.K + 1) * size.states())), stage_(g.arena, size), bar_(g.arena, size),
          scratch_(g.arena, size.states(), size.controls()) {
        unique_ = find_policies<N>(g, size, rho, policies_, values_);
    }

    int cells() const { return g_.K * size_.controls(); }
    M unique() const { return unique_; }

    /// Writes the derivative of <covector, D> by the controls [K, m], and adds that by the parameters. D are the deviations of the
    /// controls that the policies want.
    NOINLINE void pull_back(const V* covector, V* by_controls, const ParameterGradients<double>& by) {
        const int n = size_.states(), m = size_.controls(), K = g_.K;
        std::copy(covector, covector + cells(), offsets_);
        clear(state_bar_, n);
        for (int k = K - 1; k >= 0; --k) {
            expand(g_, size_, rho_, k, stage_);
            pull_back_controls(size_, stage_, policy(k), state_bar_, before_, offsets_ + k * m);
        }
        clear(value_bar_, value_size_);
        clear(states_bar_, (K + 1) * n);
        clear(by_controls, cells());
        const TrajectoryBar to{states_bar_, by_controls};
        for (int k = 0; k < K; ++k) {
            expand(g_, size_, rho_, k, stage_);
            std::copy(policy(k), policy(k) + m * size_.width(), scratch_.policy);
            pull_back_stage(size_, stage_, rho_, values_ + std::size_t(k) * value_size_, offsets_ + k * m, value_bar_, bar_, scratch_);
            pull_back_expansion(g_, size_, k, bar_, to, by);
        }
        pull_back_rollout(g_, to);
    }

  private:
    const V* policy(int k) const { return policies_ + k * size_.controls() * size_.width(); }

    const Game& g_;
    const Sizes<N>& size_;
    const double rho_;
    const int value_size_;
    V *policies_, *values_, *value_bar_, *offsets_, *state_bar_, *before_, *states_bar_;
    Stage<N> stage_, bar_;
    Scratch scratch_;
    M unique_;
};

/// Overwrites a cotangent v [K, m] by the solution y of -D_u' y = v (GMRES).
template <int N>
void solve_fixed_point(Derivative<N>& derivative, const Game& g, const EpoFeedback& run, V* cotangent) {
    const int length = derivative.cells(), terms = int(run.terms);
    const ParameterGradients<double> unused(g.arena, g.n, g.K, g.pairs);
    std::vector<V*> basis, images;
    V* const shares = g.arena.take(terms);
    // Norms of very small or large cotangents would underflow or overflow.
    V largest{};
    for (int e = 0; e < length; ++e) largest = most<double>(largest, size_of(cotangent[e]));
    largest = largest > 0 ? largest : splat(1.0);
    V* const next = g.arena.take(length);
    for (int e = 0; e < length; ++e) next[e] = cotangent[e] /= largest;
    for (int t = 0; t < terms; ++t) {
        for (const V* other : basis) subtract(next, dot(next, other, length), other, length);
        const V squared = dot(next, next, length), norm = root<double>(squared > 0 ? squared : splat(1.0));
        basis.push_back(g.arena.take(length));
        images.push_back(g.arena.take(length));
        for (int e = 0; e < length; ++e) basis[t][e] = next[e] / norm;
        derivative.pull_back(basis[t], next, unused);
        for (int e = 0; e < length; ++e) images[t][e] = next[e] = -next[e];
    }
    least_squares(g.arena, run.dependent, images, cotangent, length, shares);
    for (int e = 0; e < length; ++e) {
        V sum{};
        for (int t = 0; t < terms; ++t) sum += basis[t][e] * shares[t];
        cotangent[e] = largest * sum;
    }
}

}  // namespace

void feedback_pull_back(const EpoGame* game, const EpoFeedback* run, const EpoGradients* gradients, int64_t first, int64_t last) {
    const double* const cotangent = static_cast<const double*>(gradients->controls);
    const int64_t row = game->N * game->K * 2;
    Arena<double> arena;
    const Plan plan = plan_of(*game, first, last, [&](int64_t problem) {
        const double* of = cotangent + problem * row;
        return run->status[problem] == COMPLETED && valid<double>(*game, problem) && std::any_of(of, of + row, [](double entry) { return entry != 0; });
    });
    for_each_game(*game, arena, plan, run->controls, [&](const Game& g, const auto& size, int filled) {
        Derivative derivative(g, size, run->rho);
        const int n = g.n, K = g.K;
        V *given = arena.take(2 * n * K), *wanted = arena.take(derivative.cells()), *unused = arena.take(derivative.cells());
        g.load(n, cotangent, given, given + n * K);
        for (int k = 0; k < K; ++k)
            for (int i = 0; i < n; ++i)
                for (const int channel : {ACCELERATION, TURN_RATE}) {
                    const V entry = given[(channel ? 0 : n * K) + i * K + k];
                    wanted[(k * n + i) * kControl + channel] = g.cut ? (g.has_step(k) ? entry : V{}) : entry;
                }
        solve_fixed_point(derivative, g, *run, wanted);
        const ParameterGradients<double> by(arena, n, K, g.pairs);
        derivative.pull_back(wanted, unused, by);
        uint32_t regular = 0;
        for (int lane = 0; lane < filled; ++lane) regular |= uint32_t(derivative.unique()[lane] != 0) << lane;
        add_gradients<double>(g, by, regular, *gradients);
    });
}

}  // namespace EPO_LEVEL
