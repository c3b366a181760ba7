// Lanes of a subgroup first combine what they add to the same entry, because neighbouring samples of a ray often lie in the
// same cell. All lanes must call together.

var<private> together_lane: u32;
var<private> together_size: u32;

// No entry.
const together_NONE = 0xffffffffu;

// What this lane adds, and where.
struct Together {
    entry: u32,
    sum: vec2<f32>,
}

// The first lane of each run of lanes with the same entry gets the sum of the run, the others get nothing to add.
fn together_run(entry: u32, v: vec2<f32>) -> Together {
    let l = together_lane & 31u;
    let before = subgroupShuffleUp(entry, 1u);
    let first = l == 0u || before != entry;
    if subgroupAll(first) {
        return Together(entry, v);
    }
    let firsts = subgroupBallot(first)[together_lane >> 5u];
    let later = (firsts >> l) >> 1u;
    let end = min(select(l + 1u + countTrailingZeros(later), 32u, later == 0u), together_size);
    var sum = v;
    for (var d = 1u; d < 32u; d <<= 1u) {
        let other = subgroupShuffleDown(sum, d);
        sum += select(vec2<f32>(0.0), other, l + d < end);
    }
    return Together(select(together_NONE, entry, first), sum);
}

fn arena_scatter(i: u32, v: f32) {
    let mine = together_run(i, vec2<f32>(v, 0.0));
    if mine.entry != together_NONE {
        arena_grad(mine.entry, mine.sum.x);
    }
}

// Two lanes add the pair of the one, then that of the other: neighbouring numbers in one go.
fn arena_scatter_pair(i: u32, v: vec2<f32>) {
    let mine = together_run(i, v);
    let odd = together_lane & 1u;
    let entry = subgroupShuffleXor(mine.entry, 1u);
    let sum = subgroupShuffleXor(mine.sum, 1u);
    let is_odd = odd == 1u;
    let even_entry = select(mine.entry, entry, is_odd);
    let even = select(mine.sum.x, sum.y, is_odd);
    let odd_entry = select(entry, mine.entry, is_odd);
    let odd_sum = select(sum.x, mine.sum.y, is_odd);
    if even_entry != together_NONE {
        arena_grad(even_entry + odd, even);
    }
    if odd_entry != together_NONE {
        arena_grad(odd_entry + odd, odd_sum);
    }
}
