// Groups of agents that are solved together, and the loop over them.
#pragma once

#include <algorithm>
#include <vector>

#include "group.hpp"

namespace EPO_LEVEL {

/// Numbers of the agents of a group that move, and of the held agents in contact with them.
struct Size {
    int movers, held;
    int agents() const { return movers + held; }
};

/// Groups of agents by size: agents in contact, or all of a problem. A row is a problem, its agents that move, and the held ones, each
/// in ascending order.
class Plan {
  public:
    Plan(int64_t N, bool holds) : stride_(int(N) + 1), rows_((holds ? N : 1) * stride_) {}

    int kinds() const { return int(rows_.size()); }
    Size size(int kind) const { return {kind % stride_, kind / stride_}; }
    const std::vector<int32_t>& rows(int kind) const { return rows_[kind]; }
    std::vector<int32_t>& rows(Size size) { return rows_[size.held * stride_ + size.movers]; }
    int64_t count(int kind) const { return int64_t(rows_[kind].size()) / (size(kind).agents() + 1); }

  private:
    int stride_;
    std::vector<std::vector<int32_t>> rows_;  // by kind
};

/// Calls body(group, index, lanes in use) for every W groups of the same size; `index` counts these calls, from 0 for each size. For up
/// to 4 agents that move, their number is known at compile time.
template <class T, class Body>
void for_each_group(const EpoGame& game, Arena<T>& arena, const Plan& plan, const T* controls, const Body& body) {
    constexpr int W = Lanes<T>::W;
    for (int kind = 0; kind < plan.kinds(); ++kind) {
        const Size size = plan.size(kind);
        const int64_t count = plan.count(kind);
        for (int64_t start = 0; start < count; start += W) {
            const int32_t* rows = plan.rows(kind).data() + start * (size.agents() + 1);
            const int filled = int(std::min<int64_t>(W, count - start));
            arena.clear();
            const auto call = [&](auto known) {
                constexpr int N = decltype(known)::value;
                auto group = Group<T, N>(game, arena, Count<N>{size.movers}, size.agents(), rows, filled, controls);
                body(group, start / W, filled);
            };
            switch (size.movers) {
                case 1: call(std::integral_constant<int, 1>{}); break;
                case 2: call(std::integral_constant<int, 2>{}); break;
                case 3: call(std::integral_constant<int, 3>{}); break;
                case 4: call(std::integral_constant<int, 4>{}); break;
                default: call(std::integral_constant<int, 0>{});
            }
        }
    }
}

/// The set of the first lanes, one bit per lane.
INLINE uint32_t first_lanes(int filled) { return (uint32_t(1) << filled) - 1; }

}  // namespace EPO_LEVEL
