// The structures that Python fills, written down by the compiler: their sizes, and their fields in order with offset, size and kind.
// bindings.py writes the same of its own and compares: whoever changes a structure on one side only is told when the library is loaded.
#pragma once

#include <cstddef>
#include <string>
#include <type_traits>

#include "filter.h"
#include "mlp.h"

// p: a pointer, i: an integer, d: a number, s: a structure.
template <class T> constexpr char kind_of() {
    return std::is_pointer<T>::value ? 'p' : std::is_integral<T>::value ? 'i' : std::is_floating_point<T>::value ? 'd' : 's';
}
template <class... A> std::string kinds_of(void (*)(A...)) { return {kind_of<A>()...}; }

struct Field {
    const char* name;
    size_t offset, size;
    char kind;
};

inline std::string described(const char* name, size_t size, std::initializer_list<Field> fields) {
    std::string text = name + (" " + std::to_string(size));
    for (const Field& f : fields) text += std::string(" ") + f.name + ":" + std::to_string(f.offset) + ":" + std::to_string(f.size) + f.kind;
    return text + "\n";
}

#define FIELD(S, f) Field{#f, offsetof(S, f), sizeof(S::f), kind_of<decltype(S::f)>()}
#define CONSTANT(name, value) (std::string(name " ") + std::to_string(value) + "\n")
#define FUNCTION(f) (#f " " + kinds_of(f) + "\n")

inline std::string structures_and_constants() {
    std::string text;
#define F(f) FIELD(S, f)
#define BEGIN(name) { using S = name; text += described(#name, sizeof(S), {
#define END }); }
    BEGIN(Table) F(data), F(stride) END
    BEGIN(Places) F(data), F(stride) END
    BEGIN(Deviations) F(parameters), F(stiffness), F(curvature), F(hanging), F(pulls), F(frictions), F(places), F(kappa), F(dkappa), F(K_off),
        F(u_off), F(hangs), F(pulling) END
    BEGIN(Known) F(steps), F(tendons), F(newton), F(diagonal), F(varying), F(K_se), F(K_bt), F(K_se_inverse), F(K_bt_inverse), F(h), F(Gm), F(Wn),
        F(Wm), F(u_star), F(L), F(dr), F(tau), F(ddr), F(chord),
        F(friction), F(at), F(outputs), F(off) END
    BEGIN(Loads) F(family), F(count), F(per_load), F(size), F(axial), F(length), F(force_scale), F(eps), F(beta1), F(beta2), F(friction), F(faint), F(locations),
        F(basis), F(s), F(inside), F(node) END
    BEGIN(Task) F(known), F(loads), F(size), F(tip), F(tensions), F(registration), F(force_unit), F(moment_unit), F(length_unit),
        F(angle_unit), F(tension_unit), F(slack), F(leak), F(robust), F(offsets), F(active), F(weight), F(positions), F(w) END
    BEGIN(Filter) F(mean), F(precision), F(Q), F(step), F(decrement), F(share), F(settled), F(gain), F(exact), F(x), F(Sigma), F(before), F(cap), F(reach), F(Sigma0),
        F(done) END
    BEGIN(Sums) F(A), F(g), F(cost), F(C), F(r), F(line) END
    BEGIN(Course) F(coarse), F(fine), F(rough), F(filter), F(out), F(most), F(near), F(converged), F(iterations) END
    BEGIN(March) F(known), F(batch), F(tangents), F(load_tangents), F(reverse), F(y0), F(dy0), F(local), F(dlocal), F(out), F(dout) END
    BEGIN(Perceptron) F(depth), F(sizes), F(weights) END
#undef F
#undef BEGIN
#undef END
    return text + CONSTANT("MOST_TENDONS", MOST_TENDONS) + CONSTANT("STATE", STATE) + CONSTANT("OUT", OUT) + CONSTANT("none", NONE) + CONSTANT("gaussian", GAUSSIAN) +
           CONSTANT("paper", PAPER) + CONSTANT("point", POINT) + CONSTANT("linear", LINEAR);
}
