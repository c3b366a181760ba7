// conefield_core::backend::Loss: value and derivative at d. 3 is the difference itself, which nothing learns from.
fn penalty(d: f32) -> vec2<f32> {
    switch step.loss {
        case 0u: {
            return vec2<f32>(abs(d), sign(d));
        }
        case 1u: {
            return vec2<f32>(0.5 * d * d, d);
        }
        case 2u: {
            if abs(d) <= step.delta {
                return vec2<f32>(0.5 * d * d, d);
            }
            return vec2<f32>(step.delta * (abs(d) - 0.5 * step.delta), step.delta * sign(d));
        }
        default: {
            return vec2<f32>(d, 0.0);
        }
    }
}
