// Lanes of a subgroup that add to the same entry do so in one go: on a coarse level the samples of a ray that follow each
// other lie in the same cell. Who asks first is served first, as long as some lanes share its entry; the others add alone.
fn arena_scatter(i: u32, v: f32) {
    if v == 0.0 {
        return;
    }
    loop {
        let first = subgroupBroadcastFirst(vec2<u32>(i, lane));
        let meets = i == first.x;
        let ballot = countOneBits(subgroupBallot(meets));
        if ballot.x + ballot.y + ballot.z + ballot.w < 4u {
            break;
        }
        let sum = subgroupAdd(select(0.0, v, meets));
        if meets {
            if lane == first.y {
                arena_grad(i, sum);
            }
            return;
        }
    }
    arena_grad(i, v);
}
