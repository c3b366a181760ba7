// The image's place among the measured ones, and among those of all views.
        let image = index[i / pixels.pixels];
        var v = vec2<f32>();
        if image.x != NONE && image.y != NONE {
            let p = measured[image.x * pixels.pixels + i % pixels.pixels];
            let all = image.y * pixels.pixels + i % pixels.pixels;
            let r = select(0.0, p, INSIDE) - images[i];
            let d = DERIVATIVE;
            v = vec2<f32>(r * r, d.x);
            images[i] = WEIGHT * d.y;
        }
