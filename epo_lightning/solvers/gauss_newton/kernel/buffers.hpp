// Memory that is kept for the next call, because mapping new pages takes more time than the arithmetic in them.
#pragma once

#include <cstddef>
#include <mutex>
#include <tuple>
#include <utility>
#include <vector>

#include "lanes.hpp"

namespace EPO_LEVEL {

/// An array of vectors. Its memory comes from a pool of released arrays and returns to it.
template <class T>
class Buffer {
  public:
    Buffer() = default;
    explicit Buffer(std::size_t count) {
        const std::lock_guard<std::mutex> lock(pool().mutex);
        auto& left = pool().left;
        std::size_t best = left.size();
        for (std::size_t i = 0; i < left.size(); ++i)
            // A piece of more than twice the size is not taken: it is left for a larger array.
            if (left[i].second >= count && left[i].second <= 2 * count + kSmall && (best == left.size() || left[i].second < left[best].second))
                best = i;
        if (best == left.size()) {
            data_ = new Vec<T>[count];
            size_ = count;
        } else {
            std::tie(data_, size_) = left[best];
            pool().kept -= size_;
            left[best] = left.back();
            left.pop_back();
        }
    }
    Buffer(Buffer&& other) noexcept { swap(other); }
    Buffer& operator=(Buffer&& other) noexcept {
        swap(other);
        return *this;
    }
    ~Buffer() {
        if (!data_) return;
        const std::lock_guard<std::mutex> lock(pool().mutex);
        if (pool().kept + size_ > kMost) {
            delete[] data_;
            return;
        }
        pool().left.emplace_back(data_, size_);
        pool().kept += size_;
    }

    Vec<T>* data() const { return data_; }
    std::size_t size() const { return size_; }
    explicit operator bool() const { return data_ != nullptr; }

  private:
    static constexpr std::size_t kSmall = 4096;
    static constexpr std::size_t kMost = (std::size_t(64) << 20) / sizeof(Vec<T>);  // 64 MB are kept at most

    struct Pool {
        std::mutex mutex;
        std::vector<std::pair<Vec<T>*, std::size_t>> left;
        std::size_t kept = 0;
    };
    // The pool is never destroyed, because arrays may be released after the program's main function has ended.
    static Pool& pool() {
        static Pool* const instance = new Pool;
        return *instance;
    }
    void swap(Buffer& other) {
        std::swap(data_, other.data_);
        std::swap(size_, other.size_);
    }

    Vec<T>* data_ = nullptr;
    std::size_t size_ = 0;
};

/// An arena: pieces are taken one by one and released all at once by `clear`.
template <class T>
class Arena {
  public:
    Vec<T>* take(std::size_t count) {
        while (block_ < blocks_.size() && used_ + count > blocks_[block_].size()) ++block_, used_ = 0;
        if (block_ == blocks_.size()) blocks_.emplace_back(count > kBlock ? count : kBlock);
        Vec<T>* piece = blocks_[block_].data() + used_;
        used_ += count;
        return piece;
    }
    void clear() { block_ = used_ = 0; }

  private:
    static constexpr std::size_t kBlock = 4096;
    std::vector<Buffer<T>> blocks_;
    std::size_t block_ = 0, used_ = 0;
};

}  // namespace EPO_LEVEL
