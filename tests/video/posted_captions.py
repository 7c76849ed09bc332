"""A hundred captions as people post them, in five languages, each with the words that tell what is seen.

The captions were written for this test, after the manner of posts; half of them (`TRIED_ON`) were looked at while the
rule was made, the others (`JUDGED_ON`) were judged once, when it was done.
"""

# ruff: noqa: RUF001 - the wide marks of Chinese are meant
POSTED = {
    "English": [
        ("Lifting red box up #fyp #robotics", "Lifting red box up"),
        ("POV: you push the blue cup to the right 😂😂", "push the blue cup to the right"),
        ("Pushing mug from left to right, filmed with my phone", "Pushing mug from left to right"),
        ("putting the spoon into the mug ✨ (4k 60fps)", "putting the spoon into the mug"),
        ("Tipping bottle over | watch till the end!!", "Tipping bottle over"),
        ("Lifting can up. Link in bio 👉 https://linktr.ee/canlady", "Lifting can up"),
        (
            "@mike_builds look: pushing toy car from right to left",
            "pushing toy car from right to left",
        ),
        (
            "Stacking red block onto green block - shot on iPhone 15 Pro",
            "Stacking red block onto green block",
        ),
        (
            "🔥🔥 lifting my new watering can up 🔥🔥 like and subscribe",
            "lifting new watering can up",
        ),
        ("Covering phone with cloth (slow motion)", "Covering phone with cloth"),
        (
            "Dropping card in front of matchbox, top view, no sound",
            "Dropping card in front of matchbox",
        ),
        ("slow mo: tipping the milk carton over", "tipping the milk carton over"),
        ("Part 2 | Putting egg into pan 🍳 youtu.be/dQw4w9WgXcQ", "Putting egg into pan"),
        ("Put #sponge into the bowl #cleantok #asmr", "Put sponge into the bowl"),
        ("wait for it... pushing book off the table", "pushing book off the table"),
        (
            "Pulling camera next to phone, sorry for the bad lighting",
            "Pulling camera next to phone",
        ),
        ("Day 12 of moving things: lifting stapler up", "lifting stapler up"),
        (
            "Uncovering ball by lifting cup. Thanks for watching ❤️ follow @cupguy for more",
            "Uncovering ball by lifting cup",
        ),
        ("#shorts #viral #foryou", ""),
        ("Sliding remote to mouse [HD] [unedited]", "Sliding remote to mouse"),
    ],
    "German": [
        ("Rote Kiste hochheben #fürdich #roboter", "Rote Kiste hochheben"),
        (
            "Blaue Tasse nach rechts schieben, mit dem Handy gefilmt",
            "Blaue Tasse nach rechts schieben",
        ),
        ("POV: gelber Becher kippt um 😅", "gelber Becher kippt um"),
        ("Dose auf Teller stellen | bis zum Ende schauen!", "Dose auf Teller stellen"),
        ("Löffel wird angehoben (in 4K, ohne Ton)", "Löffel wird angehoben"),
        ("Zeitlupe: Flasche fällt um", "Flasche fällt um"),
        ("Grüner Apfel kommt hoch ✨ Link in der Bio", "Grüner Apfel kommt hoch"),
        ("Buch verschieben - Teil 3", "Buch verschieben"),
        ("@omas_kueche Ei kommt hinein 🍳🍳", "Ei kommt hinein"),
        ("Schwamm hochheben. Danke fürs Zuschauen!", "Schwamm hochheben"),
        ("Kaffeetasse anheben, aufgenommen mit GoPro", "Kaffeetasse anheben"),
        ("Würfel stapeln https://www.youtube.com/watch?v=abc123", "Würfel stapeln"),
        ("Wartet bis zum Schluss 😱 Becher fällt herunter", "Becher fällt herunter"),
        ("Schachtel umkippen (Handyvideo)", "Schachtel umkippen"),
        ("mein erstes Video: Ball schieben", "Ball schieben"),
        ("Teller heben, sorry für die schlechte Qualität", "Teller heben"),
        ("Tuch über Handy legen 1080p", "Tuch über Handy legen"),
        ("Schere verschieben ❤️ Abo dalassen nicht vergessen", "Schere verschieben"),
        ("#lustig #werkstatt #diy", ""),
        ("Draufsicht | Karton hochheben", "Karton hochheben"),
    ],
    "French": [
        ("Soulever la boîte rouge #pourtoi #robotique", "Soulever la boîte rouge"),
        (
            "Pousser la tasse bleue vers la droite, filmé avec mon téléphone",
            "Pousser la tasse bleue vers la droite",
        ),
        ("POV : tu renverses la bouteille 😂", "tu renverses la bouteille"),
        (
            "Poser la canette sur la table | regardez jusqu'à la fin",
            "Poser la canette sur la table",
        ),
        ("Je soulève la cuillère (en 4K)", "Je soulève la cuillère"),
        ("Au ralenti : le gobelet tombe", "le gobelet tombe"),
        ("Lever la pomme verte ✨ lien en bio", "Lever la pomme verte"),
        ("Déplacer le livre - partie 2", "Déplacer le livre"),
        ("@mamie_cuisine casser un œuf 🍳", "casser un œuf"),
        ("Lever l'éponge. Merci d'avoir regardé !", "Lever l'éponge"),
        ("Soulever la tasse, tourné avec une GoPro", "Soulever la tasse"),
        ("Empiler les cubes www.monsite.fr/video", "Empiler les cubes"),
        ("Attendez la fin 😱 le verre tombe", "le verre tombe"),
        ("Renverser le carton (vidéo verticale)", "Renverser le carton"),
        ("ma première vidéo : pousser la balle", "pousser la balle"),
        ("Lever l'assiette, désolé pour la qualité", "Lever l'assiette"),
        ("Couvrir le téléphone avec un torchon 60 fps", "Couvrir le téléphone avec un torchon"),
        ("Déplacer les ciseaux ❤️ abonnez-vous", "Déplacer les ciseaux"),
        ("#drole #atelier #bricolage", ""),
        ("Vue de dessus | soulever le pot", "soulever le pot"),
    ],
    "Spanish": [
        ("Levantar la caja roja #parati #robotica", "Levantar la caja roja"),
        ("Empujar la taza azul, grabado con mi móvil", "Empujar la taza azul"),
        ("POV: tiras la botella 😂", "tiras la botella"),
        ("Poner la lata en el plato | mira hasta el final", "Poner la lata en el plato"),
        ("Levanto la cuchara (en 4K, sin sonido)", "Levanto la cuchara"),
        ("Cámara lenta: el vaso se cae", "el vaso se cae"),
        ("Levantar la manzana verde ✨ link en la bio", "Levantar la manzana verde"),
        ("Mover el libro - parte 2", "Mover el libro"),
        ("@abuela_cocina romper un huevo 🍳", "romper un huevo"),
        ("Levantar la esponja. ¡Gracias por ver!", "Levantar la esponja"),
        ("Levantar la taza, filmado con una GoPro", "Levantar la taza"),
        ("Apilar los cubos https://t.co/AbC12", "Apilar los cubos"),
        ("Espera al final 😱 el plato se cae", "el plato se cae"),
        ("Volcar el cartón (video vertical)", "Volcar el cartón"),
        ("mi primer video: empujar la pelota", "empujar la pelota"),
        ("Levantar el plato, perdón por la calidad", "Levantar el plato"),
        ("Cubrir el móvil con un paño 1080p", "Cubrir el móvil con un paño"),
        ("Mover las tijeras ❤️ suscríbete", "Mover las tijeras"),
        ("#gracioso #taller #bricolaje", ""),
        ("Vista desde arriba | levantar la olla", "levantar la olla"),
    ],
    "Chinese": [
        ("把红色盒子拿起来 #机器人 #日常", "把红色盒子拿起来"),
        ("把蓝色杯子推到右边，手机拍摄", "把蓝色杯子推到右边"),
        ("第一视角：推倒瓶子😂", "推倒瓶子"),
        ("把罐子放到盘子上 | 一定要看到最后", "把罐子放到盘子上"),
        ("拿起勺子（4K 无声）", "拿起勺子"),
        ("慢动作：杯子倒了", "杯子倒了"),
        ("拿起绿苹果✨链接在简介", "拿起绿苹果"),
        ("移动书本 - 第2集", "移动书本"),
        ("@奶奶的厨房 打鸡蛋🍳", "打鸡蛋"),
        ("拿起海绵。谢谢观看！", "拿起海绵"),
        ("举起茶杯，用GoPro拍的", "举起茶杯"),
        ("叠积木 https://b23.tv/abc123", "叠积木"),
        ("看到最后😱盘子掉了", "盘子掉了"),
        ("推倒纸箱（竖屏）", "推倒纸箱"),
        ("我的第一个视频：推球", "推球"),
        ("拿起盘子，画质不好请见谅", "拿起盘子"),
        ("用布盖住手机 1080p", "用布盖住手机"),
        ("移动剪刀❤️记得点赞关注", "移动剪刀"),
        ("#搞笑 #手工 #生活", ""),
        ("俯拍｜拿起锅", "拿起锅"),
    ],
}
LATER = {
    "English": [
        ("ok so this is me lifting a yellow mug up lol", "lifting a yellow mug up"),
        (
            "Pushing toy truck to the left (recorded on my old Nokia, don't judge)",
            "Pushing toy truck to the left",
        ),
        (
            "New vid!! Putting ping pong ball into cup 🏓 comment what to do next ⬇️⬇️",
            "Putting ping pong ball into cup",
        ),
        ("tipping juice box over [OC] [no audio]", "tipping juice box over"),
        (
            "Moving eraser next to ruler - GoPro Hero 11, 120fps, wide angle",
            "Moving eraser next to ruler",
        ),
        ("*** lifting teapot up *** IG: @teatime.daily", "lifting teapot up"),
        ("Covering bowl with plate – first take, one shot, no edits", "Covering bowl with plate"),
        (
            "how to drop a coin behind the box (easy tutorial) #lifehack",
            "drop a coin behind the box",
        ),
        (
            "Day 3/30 ➡️ put the lemon into the basket, tripod is broken sorry",
            "put the lemon into the basket",
        ),
        (
            "Pulling tape from right to left. Camera: Canon R5. Music: none.",
            "Pulling tape from right to left",
        ),
        ("me, pouring nothing, just lifting a vase up (ignore the mess)", "lifting a vase up"),
        ("Knocking over a tin :) rate it 1-10", "Knocking over a tin"),
        (
            "Reposting: slide coaster from left to right // tripod shot",
            "slide coaster from left to right",
        ),
        ("lift the soap up >>> full vid on my channel", "lift the soap up"),
        ("Throwing dice into tray!!! who else does this?", "Throwing dice into tray"),
    ],
    "German": [
        (
            "Zitrone in den Korb legen 🍋 schreibt mir in die Kommentare",
            "Zitrone in den Korb legen",
        ),
        ("Spielzeugauto schieben (Kamera wackelt etwas)", "Spielzeugauto schieben"),
        ("Teekanne anheben, gefilmt von meiner Schwester", "Teekanne anheben"),
        ("Saftpackung umkippen - Folge mir für mehr", "Saftpackung umkippen"),
        ("Lineal verschieben | Full HD | 50 fps", "Lineal verschieben"),
        ("Vase anheben (Unordnung bitte ignorieren)", "Vase anheben"),
        ("Untersetzer schieben ;) ganzes Video auf meinem Kanal", "Untersetzer schieben"),
        ("Würfel in Schale werfen!!! wer kennt es?", "Würfel in Schale werfen"),
    ],
    "French": [
        (
            "Mettre le citron dans le panier 🍋 dites-moi en commentaire",
            "Mettre le citron dans le panier",
        ),
        ("Pousser la petite voiture (caméra qui tremble)", "Pousser la petite voiture"),
        ("Soulever la théière, filmé par ma sœur", "Soulever la théière"),
        ("Renverser la brique de jus - suivez-moi pour plus", "Renverser la brique de jus"),
        ("Déplacer la règle | qualité HD | son coupé", "Déplacer la règle"),
        ("Soulever le vase (ne faites pas attention au désordre)", "Soulever le vase"),
        ("Glisser le dessous de verre ;) la suite sur ma chaîne", "Glisser le dessous de verre"),
        ("Lancer les dés dans le bol !!! vous aussi ?", "Lancer les dés dans le bol"),
    ],
    "Spanish": [
        ("Poner el limón en la cesta 🍋 déjame un comentario", "Poner el limón en la cesta"),
        ("Empujar el cochecito (la cámara tiembla)", "Empujar el cochecito"),
        ("Levantar la tetera, grabado por mi hermana", "Levantar la tetera"),
        ("Volcar el brik de zumo - sígueme para más", "Volcar el brik de zumo"),
        ("Mover la regla | calidad HD | sin audio", "Mover la regla"),
        ("Levantar el jarrón (no miren el desorden)", "Levantar el jarrón"),
        ("Deslizar el posavasos ;) vídeo completo en mi canal", "Deslizar el posavasos"),
        ("Tirar los dados en el cuenco !!! ¿quién más?", "Tirar los dados en el cuenco"),
    ],
    "Chinese": [
        ("把柠檬放进篮子🍋评论区告诉我", "把柠檬放进篮子"),
        ("推玩具车（镜头有点抖）", "推玩具车"),
        ("拿起茶壶，妹妹帮我拍的", "拿起茶壶"),
        ("推倒果汁盒 - 喜欢就收藏", "推倒果汁盒"),
        ("移动尺子 | 高清 | 静音", "移动尺子"),
        ("举起花瓶（忽略背景）", "举起花瓶"),
        ("滑动杯垫～完整版在我主页", "滑动杯垫"),
        ("把骰子扔进盘子！！！你们呢？", "把骰子扔进盘子"),
    ],
}
"""Written when the rule was made, in another manner: 32 of these 47 were read right before they were looked at."""


HALVES = [
    [
        (language, *pair)
        for k, (language, pairs) in enumerate(POSTED.items())
        for pair in pairs[(k + half) % 2 :: 2]
    ]
    for half in (0, 1)
]
TRIED_ON, JUDGED_ON = HALVES
SEEN_LATER = [(language, *pair) for language, pairs in LATER.items() for pair in pairs]
