// Aligned memory that is neither zeroed nor copied when it grows; reused from view to view.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>

namespace splatseg {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer&& other) noexcept : data_(other.data_), size_(other.size_), room_(other.room_) {
    other.data_ = nullptr;
    other.size_ = other.room_ = 0;
  }
  Buffer& operator=(Buffer&&) = delete;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // Contents are lost when the buffer must grow.
  T* resize(int64_t size) {
    if (size > room_) {
      // Left empty before memory is asked for: where there is none, the destructor still runs.
      std::free(data_);
      data_ = nullptr;
      size_ = room_ = 0;
      data_ = allocate(size);
      room_ = size;
    }
    size_ = size;
    return data_;
  }
  // Contents survive; room doubles so that appending stays cheap.
  T* reserve(int64_t room) {
    if (room > room_) {
      room = room < 2 * room_ ? 2 * room_ : room;
      T* grown = allocate(room);
      if (size_) std::memcpy(grown, data_, static_cast<size_t>(size_) * sizeof(T));
      std::free(data_);
      data_ = grown;
      room_ = room;
    }
    return data_;
  }
  void set_size(int64_t size) { size_ = size; }

  T* data() { return data_; }
  const T* data() const { return data_; }
  int64_t size() const { return size_; }
  int64_t bytes() const { return room_ * static_cast<int64_t>(sizeof(T)); }
  T& operator[](int64_t i) { return data_[i]; }
  const T& operator[](int64_t i) const { return data_[i]; }

 private:
  static T* allocate(int64_t count) {
    size_t bytes = (static_cast<size_t>(count) * sizeof(T) + 63) / 64 * 64;
    void* memory = std::aligned_alloc(64, bytes ? bytes : 64);
    if (!memory) throw std::bad_alloc();
    return static_cast<T*>(memory);
  }
  T* data_ = nullptr;
  int64_t size_ = 0, room_ = 0;
};

}  // namespace splatseg
