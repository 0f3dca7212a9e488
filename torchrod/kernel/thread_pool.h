// Work in parts, shared by threads that live on from call to call: to start one, and to touch its memory for the first time, costs
// as much as an iteration of tens of samples.
#pragma once

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>

// Threads that wait for a call. They are never joined: they sleep until the process ends.
class Crew {
    struct Call {
        void (*function)(void*);
        void* with;
    };
    std::mutex taken, mutex;  // a caller has the crew to itself; the rest of what is below
    std::condition_variable begun, ended;
    Call call{};
    int64_t wanted = 0, inside = 0, size = 0;  // threads that the call has room for, that are in it, that there are

    void serve() {
        std::unique_lock<std::mutex> lock(mutex);
        for (;;) {
            begun.wait(lock, [&] { return wanted > 0; });
            wanted--, inside++;
            const Call here = call;
            lock.unlock();
            here.function(here.with);
            lock.lock();
            if (--inside == 0) ended.notify_one();
        }
    }

    // Where the system gives no more threads, those that there are do the work.
    void grow(int64_t to) {
        try {
            for (; size < to; size++) std::thread([this] { serve(); }).detach();
        } catch (const std::system_error&) {
        }
    }

  public:
    const pid_t owner = getpid();

    // function(with) on so many threads at once, or fewer; the caller's is one of them, and the only one while another caller has
    // the crew.
    void run(int64_t threads, void (*function)(void*), void* with) {
        std::unique_lock<std::mutex> mine(taken, std::try_to_lock);
        if (!mine) return function(with);
        {
            std::lock_guard<std::mutex> lock(mutex);
            grow(threads - 1);
            call = {function, with}, wanted = std::min(threads - 1, size);
        }
        for (int64_t t = 1; t < threads; t++) begun.notify_one();
        function(with);
        std::unique_lock<std::mutex> lock(mutex);
        wanted = 0;  // nothing is left for who has not come by now
        ended.wait(lock, [&] { return inside == 0; });
    }

    // This process's. A fork has none of its parent's threads, and perhaps a lock that nobody will open: it gets its own.
    static Crew& here() {
        static std::atomic<Crew*> current{nullptr};
        Crew* crew = current;
        while (!crew || crew->owner != getpid()) {
            Crew* fresh = new Crew;
            if (current.compare_exchange_strong(crew, fresh)) return *fresh;
            delete fresh;
        }
        return *crew;
    }
};

// work(take) on each of some threads, where take(from, to) gives a thread the next part of 0 .. count, no larger than `size`, or says
// that there is none: a thread takes it when it is free, so that a core which is busy elsewhere does not keep the others waiting.
template <class Work> void sharing(int64_t count, int64_t size, int64_t threads, Work work) {
    std::atomic<int64_t> next{0};
    auto all = [&] {
        work([&](int64_t& from, int64_t& to) {
            from = next.fetch_add(size), to = std::min(from + size, count);
            return from < count;
        });
    };
    threads = std::min(threads, (count + size - 1) / size);
    if (threads <= 1) return all();
    Crew::here().run(threads, [](void* with) { (*static_cast<decltype(all)*>(with))(); }, &all);
}

// work(from, to) for parts of 0 .. count, so many to a thread that none waits long for the last part of another.
template <class Work> void in_parts(int64_t count, int64_t threads, Work work) {
    sharing(count, count / (256 * threads) + 1, threads, [&](auto take) {
        for (int64_t from, to; take(from, to);) work(from, to);
    });
}
