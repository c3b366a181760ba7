let image = index[i / pixels.pixels];
        if image.x != NONE && image.y != NONE {
            let p = measured[image.x * pixels.pixels + i % pixels.pixels];
            images[i] = VALUE(p, images[i]);
        }
